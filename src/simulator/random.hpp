/// \file
/// Deterministic random numbers: the same on every platform, unlike the standard library's distributions.
#pragma once

#include <cmath>
#include <cstdint>

namespace incremental_segmatch::simulator {

/// Mixes 64 bits (a bijection in which every input bit reaches every output bit).
inline std::uint64_t Mix(std::uint64_t x) {
  x += 0x9e3779b97f4a7c15ULL;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
  return x ^ (x >> 31);
}

/// Hash of several integers, order matters.
inline std::uint64_t HashOf(std::uint64_t a, std::uint64_t b) {
  return Mix(Mix(a) ^ (b * 0xff51afd7ed558ccdULL));
}
inline std::uint64_t HashOf(std::uint64_t a, std::uint64_t b, std::uint64_t c) {
  return HashOf(HashOf(a, b), c);
}

/// Uniform in [0, 1) from the upper bits of a hash.
inline double ToUnit(std::uint64_t hash) {
  return static_cast<double>(hash >> 11) * 0x1.0p-53;
}

/// A small stream of random numbers from one seed.
class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(Mix(seed)) {}

  std::uint64_t Bits() { return Mix(state_ += 0x9e3779b97f4a7c15ULL); }
  double Uniform() { return ToUnit(Bits()); }
  double Uniform(double low, double high) { return low + (high - low) * Uniform(); }
  float UniformF(double low, double high) { return static_cast<float>(Uniform(low, high)); }
  bool Chance(double probability) { return Uniform() < probability; }
  int Index(int count) { return static_cast<int>(Uniform() * count); }
  /// Standard normal (Box and Muller, one of the pair).
  double Normal() {
    const double u = 1.0 - Uniform();
    const double v = Uniform();
    return std::sqrt(-2.0 * std::log(u)) * std::cos(6.283185307179586 * v);
  }

 private:
  std::uint64_t state_;
};

}  // namespace incremental_segmatch::simulator
