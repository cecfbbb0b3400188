/// \file
/// All parameters, and the one parser of them.
#pragma once

#include <string>
#include <vector>

#include "incremental_segmatch/back_end.hpp"
#include "incremental_segmatch/front_end.hpp"

namespace incremental_segmatch {

/// Everything that can be set of the two sides of the core.
struct Parameters {
  FrontEndParameters front_end;  ///< the robot side
  BackEndParameters back_end;    ///< the map side
};

/// Reads a YAML file over the defaults. Throws std::invalid_argument on an unknown or repeated key, a wrong type or a
/// value out of range, naming the key's full path; std::runtime_error naming the file if it can't be read or isn't
/// YAML.
Parameters LoadParameters(const std::string& path);

/// The same from YAML text; `origin` names it in messages.
Parameters ParseParameters(const std::string& yaml, const std::string& origin);

/// All parameters as YAML, in the form that ParseParameters reads: ParseParameters(ToYaml(p), ..) equals p, bit for
/// bit.
std::string ToYaml(const Parameters& parameters);

/// Throws std::invalid_argument naming the parameter that is out of range, by its full path. FrontEnd and BackEnd
/// accept what passes.
void Validate(const Parameters& parameters);

/// The page docs/parameters.md: key, default, unit, range and meaning of each parameter, by section.
std::string ParametersAsMarkdown();

/// Full paths of all parameters, in the order of the page.
std::vector<std::string> ParameterKeys();

}  // namespace incremental_segmatch
