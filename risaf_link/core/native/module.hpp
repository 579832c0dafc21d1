// What the parts of the Python module share.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstddef>
#include <initializer_list>

namespace nb = nanobind;

template <typename T>
using Array = nb::ndarray<nb::numpy, T>;

// Hand an array over to Python.
template <typename T>
Array<T> owned(T* values, std::initializer_list<std::size_t> shape) {
  nb::capsule owner(values, [](void* p) noexcept { delete[] static_cast<T*>(p); });
  return Array<T>(values, shape, owner);
}

void bind_filter(nb::module_& m);
void bind_frames(nb::module_& m);
