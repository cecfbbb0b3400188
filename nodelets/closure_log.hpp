/// \file
/// Accepted recognitions as a CSV file with the columns of `segmatch evaluate`.
#pragma once

#include <fstream>
#include <string>

#include "incremental_segmatch/back_end.hpp"

namespace incremental_segmatch {

/// A closures.csv that is complete after every row: one for every accepted recognition, between sensor poses, stamps in
/// seconds on the clock of the input.
class ClosureLog {
 public:
  /// Starts the file, over an older one. Throws std::runtime_error naming the file if it can't be written.
  explicit ClosureLog(const std::string& path);

  /// Throws std::runtime_error naming the file if it can't be written.
  void Add(const Closure& closure);

 private:
  std::string path_;
  std::ofstream file_;
};

}  // namespace incremental_segmatch
