/// \file
/// All parameters, and the one parser of them.
#pragma once

#include <string>

#include "incremental_segmatch/back_end.hpp"
#include "incremental_segmatch/front_end.hpp"

namespace incremental_segmatch {

struct Parameters {
  FrontEndParameters front_end;
  BackEndParameters back_end;
};

/// Reads a YAML file over the defaults. Throws std::invalid_argument on an unknown key, a wrong type or a value out of range,
/// naming the key's full path; std::runtime_error naming the file if it can't be read or isn't YAML.
Parameters LoadParameters(const std::string& path);

/// The same from YAML text; `origin` names it in messages.
Parameters ParseParameters(const std::string& yaml, const std::string& origin);

/// All parameters as YAML, in the form that ParseParameters reads.
std::string ToYaml(const Parameters& parameters);

/// Throws std::invalid_argument naming the parameter that is out of range.
void Validate(const Parameters& parameters);

}  // namespace incremental_segmatch
