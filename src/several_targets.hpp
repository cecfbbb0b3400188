/// \file
/// Functions that are compiled for several processors.
#pragma once

/// Compiled for processors with AVX2 and AVX-512 as well, and chosen at run time; the results are the same.
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__gnu_linux__)
#define SEGMATCH_SEVERAL_TARGETS __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define SEGMATCH_SEVERAL_TARGETS
#endif
