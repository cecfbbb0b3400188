#!/usr/bin/env python3
"""Prints google-benchmark's results as one Markdown table. Arguments: result files without their .json."""
import json
import os
import sys


def rows_of(path):
    if not os.path.exists(path) or os.path.getsize(path) == 0:
        return
    with open(path) as file:
        results = json.load(file)
    for run in results["benchmarks"]:
        if run.get("run_type") == "aggregate" or run.get("error_occurred"):
            continue
        to_ms = {"ns": 1e-6, "us": 1e-3, "ms": 1.0, "s": 1e3}[run["time_unit"]]
        # Stages on a drive report the median over its steps; the others CPU time per call.
        milliseconds = run.get("median_ms", to_ms * run["cpu_time"])
        parts = [part for part in run["name"].split("/") if not part.startswith(("iterations", "manual_time"))]
        recognition_stages = {"RecognizeOurs": "recognition", "RecognizeSequence": "consistency graph of a drive"}
        if parts[0] in recognition_stages:
            yield recognition_stages[parts[0]], parts[2], parts[1], milliseconds, run
        elif parts[0] == "RecognizeInDistricts":
            stage = f"recognition without border, tested with {run['tested_per_correspondence']:.0f} each"
            yield stage, parts[2], parts[1], milliseconds, run
        elif parts[0] == "GroupWithPcl":
            yield "recognition", parts[1], "pcl", milliseconds, run
        else:
            yield parts[0], parts[1], parts[2], milliseconds, run


def main(paths):
    rows = [row for path in paths for row in rows_of(path + ".json")]
    pcl = {(stage, size): ms for stage, size, method, ms, _ in rows if method == "pcl"}
    for stage, size, method, ms, _ in rows:  # smoothness has no tree of its own to build: normals built it
        if method == "pcl_tree_shared":
            pcl.setdefault((stage, size), ms)
    print("| stage | size | method | ms | PCL / this | voxels | bytes a voxel |")
    print("|---|---|---|---|---|---|---|")
    for stage, size, method, ms, run in rows:
        reference = pcl.get((stage, size))
        ratio = f"{reference / ms:.1f}" if reference else "–"
        voxels = f"{run['voxels']:.0f}" if "voxels" in run else "–"
        bytes_per_voxel = f"{run['bytes_per_voxel']:.0f}" if "bytes_per_voxel" in run else "–"
        print(f"| {stage} | {size} | {method} | {ms:.3f} | {ratio} | {voxels} | {bytes_per_voxel} |")


if __name__ == "__main__":
    main(sys.argv[1:])
