/// \file
/// Drawings as text: inline SVG whose colours are classes of the page's style sheet.
#pragma once

#include <Eigen/Core>
#include <string>
#include <vector>

namespace incremental_segmatch {

/// Text with &, <, > and quotes escaped for HTML.
std::string EscapeHtml(const std::string& text);

/// printf for one number; a dash where it is NaN.
std::string FormatNumber(double value, const char* format);

/// A drawing of a given size in its own units (y downwards) that scales with the page.
class Svg {
 public:
  Svg(double width, double height, const std::string& title);

  void Line(double x0, double y0, double x1, double y1, const std::string& style_class);
  /// Points that are nearer to the last drawn one than half a unit are left out.
  void Path(const std::vector<Eigen::Vector2d>& points, const std::string& style_class);
  void Rectangle(double x, double y, double width, double height, const std::string& style_class);
  /// `tip` is shown where the pointer rests.
  void Circle(double x, double y, double radius, const std::string& style_class, const std::string& tip = {});
  /// `anchor`: start, middle or end.
  void Text(double x, double y, const std::string& text, const std::string& anchor = "start",
            const std::string& style_class = "label");

  /// The whole element.
  std::string Finish() const { return text_ + "</svg>\n"; }

 private:
  std::string text_;
};

/// A curve of a Plot.
struct Curve {
  std::string name;         ///< written at its end
  std::string style_class;  ///< colour
  std::vector<Eigen::Vector2d> points;
};

/// Curves over common axes, both from 0 on.
struct Plot {
  std::string title;
  std::string x_label;
  std::string y_label;
  double x_max = 1.0;
  double y_max = 1.0;
  std::vector<Curve> curves;
  std::vector<std::pair<double, std::string>> x_marks;  ///< upright lines with a word
};

/// The plot as SVG.
std::string Draw(const Plot& plot);

/// A horizontal bar per row.
struct BarRow {
  std::string name;
  double value = 0.0;   ///< length of the bar
  double extent = 0.0;  ///< length of a fainter bar behind it; not drawn if below value
  std::string words;    ///< written behind the bars
};

/// Rows of bars on one scale.
std::string DrawBars(const std::vector<BarRow>& rows, const std::string& title);

}  // namespace incremental_segmatch
