/// \file
/// Array that grows without moving its elements, on huge pages where the system has them.
#pragma once

#if defined(__linux__)
#include <sys/mman.h>
#endif

#include <cstddef>
#include <memory>
#include <new>
#include <type_traits>
#include <vector>

namespace incremental_segmatch {

/// Elements stay where they are for the array's life. Memory is asked for in 2 MB pages: elements that are visited in
/// no order miss the caches of address translation otherwise. O(1) access; growing is O(new elements), whatever is there
/// already. For trivially destructible types of at most 2 MB.
template <class T>
class PagedArray {
  static_assert(std::is_trivially_destructible_v<T>, "elements are not destroyed one by one");

 public:
  /// Number of elements.
  std::size_t size() const { return size_; }
  /// Memory held.
  std::size_t memory_bytes() const { return pages_.size() * kPageBytes; }
  /// Element i < size().
  T& operator[](std::size_t i) { return pages_[i / kPerPage].get()[i % kPerPage]; }
  /// Element i < size().
  const T& operator[](std::size_t i) const { return pages_[i / kPerPage].get()[i % kPerPage]; }

  /// Makes it at least this many elements; new ones are value-initialized.
  void Grow(std::size_t size) {
    for (; size_ < size; ++size_) {
      if (size_ == pages_.size() * kPerPage) AddPage();
      new (&(*this)[size_]) T();
    }
  }

 private:
  static constexpr std::size_t kHugePage = std::size_t{1} << 21;
  static constexpr std::size_t kPageBytes = kHugePage;
  static constexpr std::size_t kPerPage = kPageBytes / sizeof(T);
  struct Free {
    void operator()(T* memory) const { ::operator delete (memory, std::align_val_t{kHugePage}); }
  };
  void AddPage() {
    void* const memory = ::operator new (kPageBytes, std::align_val_t{kHugePage});
#if defined(__linux__)
    madvise(memory, kPageBytes, MADV_HUGEPAGE);  // advice: works without
#endif
    pages_.emplace_back(static_cast<T*>(memory));
  }

  std::vector<std::unique_ptr<T, Free>> pages_;
  std::size_t size_ = 0;
};

}  // namespace incremental_segmatch
