// starcat onboard for C++17: an image is opened where it lies, a matcher holds what it works in, arrays
// are spans. No heap, no exceptions; header only, over starcat.h.
//
// SPDX-License-Identifier: MIT
#ifndef STARCAT_HPP
#define STARCAT_HPP

#include <cstddef>
#include <cstdint>
#include <string_view>

#include "starcat.h"

namespace starcat {

using real = starcat_real;
using camera = starcat_camera;
using options = starcat_options;

// Consecutive elements of somebody else: of an array, a std::array or a std::vector.
template <typename T>
class span {
 public:
  constexpr span() noexcept = default;
  constexpr span(T *data, std::size_t size) noexcept : data_(data), size_(size) {}
  template <std::size_t N>
  constexpr span(T (&array)[N]) noexcept : data_(array), size_(N) {}
  template <typename Container,
            typename = decltype(static_cast<T *>(static_cast<const Container *>(nullptr)->data()))>
  constexpr span(const Container &container) noexcept
      : data_(container.data()), size_(container.size()) {}
  constexpr T *data() const noexcept { return data_; }
  constexpr std::size_t size() const noexcept { return size_; }
  constexpr bool empty() const noexcept { return size_ == 0; }
  constexpr T &operator[](std::size_t n) const noexcept { return data_[n]; }
  constexpr T *begin() const noexcept { return data_; }
  constexpr T *end() const noexcept { return data_ + size_; }

 private:
  T *data_ = nullptr;
  std::size_t size_ = 0;
};

// An image, opened where its bytes lie; they have to begin at a multiple of 8 and outlive it.
class image {
 public:
  explicit image(span<const std::uint8_t> bytes, std::uint32_t flags = 0) noexcept
      : status_(starcat_open_image(&image_, bytes.data(), bytes.size(), flags)),
        size_(bytes.size()) {}
  // Of the 64-bit words that starcat export --to c writes.
  explicit image(span<const std::uint64_t> words, std::uint32_t flags = 0) noexcept
      : status_(starcat_open_image(&image_, words.data(), 8u * words.size(), flags)),
        size_(8u * words.size()) {}

  starcat_status status() const noexcept { return status_; }
  explicit operator bool() const noexcept { return status_ == STARCAT_OK; }
  const starcat_image *get() const noexcept { return &image_; }

  // What follows is of an image that was opened.
  span<const std::int64_t> star_ids() const noexcept { return {image_.star_ids, image_.n_stars}; }
  std::string_view name() const noexcept {
    std::size_t size = 0;
    while (size < 96u && image_.name[size] != '\0') {
      size++;
    }
    return {image_.name, size};
  }
  // The camera that it was built for, to be calibrated.
  starcat::camera camera() const noexcept {
    starcat::camera made{};
    (void)starcat_get_camera(&image_, &made);
    return made;
  }
  // List the neighbours of every star, so that frames that triangles do not solve are solved by votes:
  // starcat_list_neighbours says what the table has to have. The table has to outlive the image. If
  // this fails, frames are solved without votes.
  starcat_status list_neighbours(starcat_neighbours &table, starcat_workspace &work) noexcept {
    image_.neighbours = nullptr;
    const starcat_status listed = starcat_list_neighbours(&image_, &work, &table);
    if (listed == STARCAT_OK) {
      image_.neighbours = &table;
    }
    return listed;
  }
  // Check blocks `first` to `first + count`, in idle time.
  starcat_status scrub(std::uint32_t first, std::uint32_t count,
                       std::uint32_t &bad_block) const noexcept {
    return starcat_scrub_image(image_.bytes, size_, first, count, &bad_block);
  }

 private:
  starcat_image image_{};
  starcat_status status_;
  std::size_t size_;
};

// The centroids of a frame; magnitudes and noises may be left out.
struct frame {
  span<const real> x_px, y_px, magnitudes{}, sigma_px{};
};

// A prior attitude, x, y, z, w as starcat.h describes it, and its largest error as an angle.
struct prior {
  real q_body_from_icrs[4];
  real uncertainty_rad;
};

inline starcat::options default_options() noexcept {
  starcat::options made{};
  (void)starcat_set_default_options(&made);
  return made;
}

// What identifies frames with an image: camera and options, to be changed at will, and the memory that
// a call works in, 37 KiB. Make it static, not on a stack; a thread needs its own.
class matcher {
 public:
  explicit matcher(const image &of) noexcept : image_(&of) {
    if (of) {
      camera = of.camera();
    }
  }
  matcher(image &&) = delete;  // the image has to outlive it
  matcher(const matcher &) = delete;
  matcher &operator=(const matcher &) = delete;

  starcat::camera camera{};
  starcat::options options = default_options();

  // Arrays of different lengths are STARCAT_E_NULL, an image that did not open is its status.
  starcat_status identify(const frame &given) noexcept { return call(given, nullptr); }
  starcat_status track(const frame &given, const prior &near) noexcept {
    return call(given, &near);
  }

  // The answer to the last frame; a row of the image for each of its centroids, or a number below 0.
  const starcat_result &result() const noexcept { return result_; }
  span<const std::int32_t> stars() const noexcept { return {result_.star, count_}; }

 private:
  starcat_status call(const frame &given, const prior *near) noexcept {
    const std::size_t count = given.x_px.size();
    count_ = 0;
    result_ = starcat_result{};
    if (!*image_) {
      return image_->status();
    }
    if (given.y_px.size() != count || !fits(given.magnitudes, count) ||
        !fits(given.sigma_px, count)) {
      return STARCAT_E_NULL;
    }
    if (count > STARCAT_MAX_CENTROIDS) {
      return STARCAT_E_TOO_MANY_CENTROIDS;
    }
    const starcat_frame arrays = {static_cast<std::uint32_t>(count), given.x_px.data(),
                                  given.y_px.data(), given.magnitudes.data(),
                                  given.sigma_px.data()};
    const starcat_status status =
        near == nullptr
            ? starcat_identify_frame(image_->get(), &camera, &options, &arrays, &work_, &result_)
            : starcat_track_frame(image_->get(), &camera, &options, &arrays, near->q_body_from_icrs,
                                  near->uncertainty_rad, &work_, &result_);
    count_ = status >= 0 || status == STARCAT_E_BUDGET ? count : 0u;
    return status;
  }
  static bool fits(span<const real> given, std::size_t count) noexcept {
    return given.empty() || given.size() == count;
  }

  const image *image_;
  std::size_t count_ = 0;
  starcat_workspace work_{};
  starcat_result result_{};
};

}  // namespace starcat

#endif
