/// \file
/// Many runs in one table: mean and range over the runs of each drive.
#pragma once

#include <string>
#include <vector>

namespace incremental_segmatch {

/// Runs of one drive that differ by their seed.
struct RunGroup {
  std::string drive;
  std::vector<std::string> summaries;  ///< paths of summary.json files
};

/// One row per drive in Markdown: figures as mean and (least to greatest) over the runs, counts of false closures as
/// sums, and a second table with the causes of missed revisits. The last row is over all drives: its precision is that
/// of all closures together. Throws std::runtime_error naming a file that can't be read or is no summary.
std::string RunTableMarkdown(const std::vector<RunGroup>& groups);

/// The same figures for programs: by drive and figure mean, least, greatest and the number of runs that have it.
std::string RunTableJson(const std::vector<RunGroup>& groups);

}  // namespace incremental_segmatch
