#!/usr/bin/env bash
# Builds and runs the benchmarks, and prints one table: median time of each stage, ours beside PCL's and the thesis's structures.
# Arguments go to every program, so that --benchmark_filter=/2e5/ runs one size only. Results are kept in build/benchmark/*.json.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
if [[ ${1:-} == --help || ${1:-} == -h ]]; then
  sed -n '2,3s/^# //p' "${BASH_SOURCE[0]}"
  exit 0
fi
mkdir -p "$root/build/benchmark"
programs=(voxel_grid_benchmark normals_benchmark segmentation_benchmark matching_benchmark recognition_benchmark)
[[ -f $root/build/Makefile ]] || "$root/scripts/build.sh"
make -C "$root/build" --no-print-directory "${programs[@]}" >/dev/null
for program in "${programs[@]}"; do
  echo "benchmark.sh: $program" >&2
  "$root/devel/lib/incremental_segmatch/$program" "$@" --benchmark_out="$root/build/benchmark/$program.json" --benchmark_out_format=json >/dev/null
done
python3 "$root/scripts/benchmark_table.py" "${programs[@]/#/$root/build/benchmark/}"
