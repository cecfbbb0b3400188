#include "evaluation/svg.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>

namespace incremental_segmatch {
namespace {

std::string Number(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.1f", value);
  return text;
}

std::string Attribute(const char* name, double value) {
  return std::string(" ") + name + "=\"" + Number(value) + "\"";
}

std::string Class(const std::string& style_class) {
  return " class=\"" + style_class + "\"";
}

// A round step that divides a range into four to ten parts.
double TickStep(double range) {
  const double power = std::pow(10.0, std::floor(std::log10(range)));
  for (const double step : {0.1, 0.2, 0.25, 0.5, 1.0}) {
    if (range / (step * power) <= 10.0 + 1e-9 && step * power >= range / 10.0) return step * power;
  }
  return power;
}

}  // namespace

std::string EscapeHtml(const std::string& text) {
  std::string escaped;
  for (const char c : text) {
    switch (c) {
      case '&':
        escaped += "&amp;";
        break;
      case '<':
        escaped += "&lt;";
        break;
      case '>':
        escaped += "&gt;";
        break;
      case '"':
        escaped += "&quot;";
        break;
      default:
        escaped += c;
    }
  }
  return escaped;
}

std::string FormatNumber(double value, const char* format) {
  if (std::isnan(value)) return "–";
  char text[64];
  std::snprintf(text, sizeof text, format, value);
  return text;
}

Svg::Svg(double width, double height, const std::string& title)
    : text_("<svg viewBox=\"0 0 " + Number(width) + " " + Number(height) + "\" role=\"img\" aria-label=\"" +
            EscapeHtml(title) + "\">\n") {}

void Svg::Line(double x0, double y0, double x1, double y1, const std::string& style_class) {
  text_ += "<line" + Class(style_class) + Attribute("x1", x0) + Attribute("y1", y0) + Attribute("x2", x1) +
           Attribute("y2", y1) + "/>\n";
}

void Svg::Path(const std::vector<Eigen::Vector2d>& points, const std::string& style_class) {
  if (points.empty()) return;
  text_ += "<polyline" + Class(style_class) + " points=\"";
  Eigen::Vector2d last = points.front();
  for (std::size_t i = 0; i < points.size(); ++i) {
    if (i > 0 && i + 1 < points.size() && (points[i] - last).norm() < 0.5) continue;
    last = points[i];
    text_ += (i > 0 ? " " : "") + Number(last.x()) + "," + Number(last.y());
  }
  text_ += "\"/>\n";
}

void Svg::Rectangle(double x, double y, double width, double height, const std::string& style_class) {
  text_ += "<rect" + Class(style_class) + Attribute("x", x) + Attribute("y", y) +
           Attribute("width", std::max(0.0, width)) + Attribute("height", height) + "/>\n";
}

void Svg::Circle(double x, double y, double radius, const std::string& style_class, const std::string& tip) {
  text_ += "<circle" + Class(style_class) + Attribute("cx", x) + Attribute("cy", y) + Attribute("r", radius);
  text_ += tip.empty() ? "/>\n" : "><title>" + EscapeHtml(tip) + "</title></circle>\n";
}

void Svg::Text(double x, double y, const std::string& text, const std::string& anchor, const std::string& style_class) {
  text_ += "<text" + Class(style_class) + Attribute("x", x) + Attribute("y", y) + " text-anchor=\"" + anchor + "\">" +
           EscapeHtml(text) + "</text>\n";
}

std::string Draw(const Plot& plot) {
  constexpr double kWidth = 460, kHeight = 270, kLeft = 40, kTop = 26, kBottom = 44, kPerLetter = 6.8;
  std::size_t letters = 0;
  for (const Curve& curve : plot.curves) letters = std::max(letters, curve.name.size());
  const double right = std::max(30.0, 10.0 + kPerLetter * static_cast<double>(letters));
  const double x_max = plot.x_max > 0.0 ? plot.x_max : 1.0, y_max = plot.y_max > 0.0 ? plot.y_max : 1.0;
  const auto x_of = [&](double x) { return kLeft + (kWidth - kLeft - right) * std::min(x, x_max) / x_max; };
  const auto y_of = [&](double y) {
    return kHeight - kBottom - (kHeight - kTop - kBottom) * std::min(y, y_max) / y_max;
  };
  Svg svg(kWidth, kHeight, plot.title);
  const double x_step = TickStep(x_max), y_step = TickStep(y_max);
  for (double y = 0.0; y <= y_max * (1 + 1e-9); y += y_step) {
    svg.Line(kLeft, y_of(y), kWidth - right, y_of(y), "grid");
    svg.Text(kLeft - 6, y_of(y) + 4, FormatNumber(y, "%.3g"), "end");
  }
  for (double x = 0.0; x <= x_max * (1 + 1e-9); x += x_step) {
    svg.Line(x_of(x), kHeight - kBottom, x_of(x), kHeight - kBottom + 4, "axis");
    svg.Text(x_of(x), kHeight - kBottom + 17, FormatNumber(x, "%.3g"), "middle");
  }
  svg.Line(kLeft, kHeight - kBottom, kWidth - right, kHeight - kBottom, "axis");
  svg.Text(0.5 * (kLeft + kWidth - right), kHeight - 8, plot.x_label, "middle");
  svg.Text(kLeft - 34, 12, plot.y_label, "start");
  double word_end = 0.0;
  int level = 0;
  for (const auto& [x, word] : plot.x_marks) {
    if (!(x <= x_max)) continue;
    level = x_of(x) < word_end ? level + 1 : 0;
    const double width = kPerLetter * static_cast<double>(word.size());
    const bool fits = x_of(x) + width < kWidth;
    word_end = x_of(x) + (fits ? width : 0.0);
    svg.Line(x_of(x), kTop, x_of(x), kHeight - kBottom, "mark");
    svg.Text(x_of(x) + (fits ? 4 : -4), kTop + 12 + 14 * level, word, fits ? "start" : "end");
  }
  double last_label = -100.0;
  for (const Curve& curve : plot.curves) {
    std::vector<Eigen::Vector2d> points;
    for (const Eigen::Vector2d& p : curve.points) points.emplace_back(x_of(p.x()), y_of(p.y()));
    svg.Path(points, "curve " + curve.style_class);
    if (points.empty()) continue;
    double y = points.back().y() + 4;
    if (std::abs(y - last_label) < 14) y = last_label + 14;
    last_label = y;
    svg.Text(kWidth - right + 6, y, curve.name, "start", "label ink-" + curve.style_class);
  }
  return svg.Finish();
}

std::string DrawBars(const std::vector<BarRow>& rows, const std::string& title) {
  constexpr double kWidth = 460, kRow = 22, kLeft = 136, kWords = 130;
  double longest = 0.0;
  for (const BarRow& row : rows) longest = std::max({longest, row.value, row.extent});
  if (!(longest > 0.0)) longest = 1.0;
  Svg svg(kWidth, kRow * static_cast<double>(rows.size()) + 6, title);
  const double scale = (kWidth - kLeft - kWords) / longest;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const double y = 3 + kRow * static_cast<double>(i);
    svg.Text(kLeft - 8, y + 15, rows[i].name, "end");
    if (rows[i].extent > rows[i].value) svg.Rectangle(kLeft, y + 4, scale * rows[i].extent, kRow - 8, "bar-extent");
    if (rows[i].value > 0.0) svg.Rectangle(kLeft, y + 4, scale * rows[i].value, kRow - 8, "bar");
    svg.Text(kLeft + scale * std::max({0.0, rows[i].value, rows[i].extent}) + 6, y + 15, rows[i].words);
  }
  return svg.Finish();
}

}  // namespace incremental_segmatch
