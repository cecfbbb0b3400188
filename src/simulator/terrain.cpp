#include "simulator/terrain.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "simulator/random.hpp"

namespace incremental_segmatch::simulator {
namespace {

constexpr int kWaves = 5;
constexpr double kMaxSamples = 4e6;

struct Wave {
  Eigen::Vector2d frequency;
  double amplitude_m;
  double phase;
};

std::array<Wave, kWaves> DrawWaves(std::uint64_t seed, double grade) {
  Random random(HashOf(seed, 1001));
  std::array<Wave, kWaves> waves;
  for (Wave& wave : waves) {
    const double length_m = random.Uniform(90.0, 400.0);
    const double angle = random.Uniform(0.0, 6.283185307179586);
    const double frequency = 6.283185307179586 / length_m;
    wave.frequency = frequency * Eigen::Vector2d(std::cos(angle), std::sin(angle));
    wave.amplitude_m = grade / kWaves / frequency;
    wave.phase = random.Uniform(0.0, 6.283185307179586);
  }
  return waves;
}

}  // namespace

Terrain::Terrain(std::uint64_t seed, const Eigen::Vector2d& low_m, const Eigen::Vector2d& high_m, double grade)
    : low_m_(low_m), steepest_(std::max(1e-3, 1.5 * grade)) {
  const Eigen::Vector2d size = high_m - low_m;
  spacing_m_ = std::max(4.0, std::sqrt(size.x() * size.y() / kMaxSamples));
  per_spacing_ = 1.0 / spacing_m_;
  columns_ = std::max(2, static_cast<int>(std::ceil(size.x() / spacing_m_)) + 1);
  rows_ = std::max(2, static_cast<int>(std::ceil(size.y() / spacing_m_)) + 1);
  heights_m_.resize(static_cast<std::size_t>(columns_) * rows_);
  const auto waves = DrawWaves(seed, grade);
  for (int row = 0; row < rows_; ++row) {
    for (int column = 0; column < columns_; ++column) {
      const Eigen::Vector2d p = low_m_ + spacing_m_ * Eigen::Vector2d(column, row);
      double height = 0.0;
      for (const Wave& wave : waves) height += wave.amplitude_m * std::sin(wave.frequency.dot(p) + wave.phase);
      heights_m_[static_cast<std::size_t>(row) * columns_ + column] = static_cast<float>(height);
    }
  }
}

Eigen::Vector3d Terrain::Normal(const Eigen::Vector2d& p) const {
  constexpr double kHalfBase_m = 1.4;
  const double dx = Height(p.x() + kHalfBase_m, p.y()) - Height(p.x() - kHalfBase_m, p.y());
  const double dy = Height(p.x(), p.y() + kHalfBase_m) - Height(p.x(), p.y() - kHalfBase_m);
  return Eigen::Vector3d(-dx / (2 * kHalfBase_m), -dy / (2 * kHalfBase_m), 1.0).normalized();
}

}  // namespace incremental_segmatch::simulator
