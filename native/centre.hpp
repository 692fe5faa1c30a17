// Centre of the sector of a point, limited to the range of s that the flight covers. docs/theory/integration.md, (4).
#pragma once
#include <cmath>

#include "job.hpp"

namespace {

// Smallest and largest s of (1) at a point, the ends with these values, and the largest change of s within `reach`
// metres of the point.
struct Flown {
  double first, last, slack;
  int64_t first_end, last_end;
};

inline Flown flown_past(const SectorJob& sector, const double* at, double reach) {
  Flown out = {2, -2, 0, -1, -1};
  for (int64_t end = 0; end < sector.ends; end++) {
    double place = 0, slack = 0;
    for (int64_t leg = 0; leg < 2; leg++) {
      const double *antenna = sector.end[leg] + 3 * end, *axis = sector.end_axis[leg] + 3 * end;
      double along = 0, square = 0, length = 0;
      for (int64_t n = 0; n < 3; n++) {
        const double w = at[n] - antenna[n];
        along += w * axis[n], square += w * w, length += axis[n] * axis[n];
      }
      const double distance = std::sqrt(square);
      place += along / distance;
      if (reach > 0) slack += std::sqrt(length) * (reach < distance ? 1.5708 * reach / distance : 2);
    }
    if (place < out.first) out.first = place, out.first_end = end;
    if (place > out.last) out.last = place, out.last_end = end;
    out.slack = std::fmax(out.slack, slack);
  }
  return out;
}

// Centre by (4); NaN for a point with non-finite coordinates.
inline double centre_of(const SectorJob& sector, const Flown& own) {
  const double middle = 0.5 * (own.first + own.last);
  const double lowest = std::fmin(own.first + sector.outer, middle),
               highest = std::fmax(own.last - sector.outer, middle);
  return own.first_end < 0 ? NAN : std::fmin(std::fmax(sector.centre, lowest), highest);
}

}  // namespace
