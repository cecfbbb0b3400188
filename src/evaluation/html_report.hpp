/// \file
/// report.html: a run as one page for people, without scripts or anything from elsewhere.
#pragma once

#include <string>

#include "evaluation/evaluation.hpp"

namespace incremental_segmatch {

/// The page of a run: what was found, the map with its closures, gaps, times, acceptance, misses with their causes, and
/// the thesis's figures beside. Its numbers are those of summary.json.
std::string ReportHtml(const EvaluationResult& result);

/// A page in the report's style: head, style sheet and title around a body.
std::string HtmlPage(const std::string& title, const std::string& body);

/// A table; the first row is its head; cells are HTML. Numbers belong into all columns but the first.
std::string HtmlTable(const std::vector<std::vector<std::string>>& rows);

}  // namespace incremental_segmatch
