// Weights of antennas and of the sector over a tile: classification of leaves with constant weight 1 or 0, and weights
// of the other leaves at their nodes. Numbers in brackets are equations of docs/theory/tree.md, "Weights".
#pragma once
#include "centre.hpp"
#include "pattern.hpp"
#include "tree_lattice.hpp"

namespace {

using apertura::kDirectly;
using apertura::kNoEcho;
using apertura::kTreeGroup;
using apertura::kTreeWeights;

constexpr double kKink = 0.28647889757;  // 9 / (10 pi) of (13)
constexpr int64_t kTerms = 4;            // terms of a polynomial of weights along xi and along eta
constexpr int64_t kBetween = 5;          // points along an axis at which the polynomial is checked
constexpr int64_t kChecked = 8;          // every kChecked-th pulse is checked
constexpr int64_t kCurve = 6;            // polynomial terms of weights over the pulses of a leaf
constexpr double kLargest = 3;           // ratio of the largest error and the RMS error
constexpr double kPlaceError = 2e-6;     // error of s due to float32

// Geometry of a pulse or virtual pulse over a tile: paths, and axes of the sector.
struct Look {
  Legs legs;
  float axis[2][3] = {}, along[2] = {};  // a, and a . w in metres
};

inline void put_axes(const double* centre, const double* transmitter, const double* receiver, const double (*axis)[3],
                     Look& look) {
  for (int64_t leg = 0; leg < 2; leg++) {
    const double* antenna = leg ? receiver : transmitter;
    double along = 0;
    for (int64_t n = 0; n < 3; n++)
      look.axis[leg][n] = float(axis[leg][n]), along += (centre[n] - antenna[n]) * axis[leg][n];
    look.along[leg] = float(along);
  }
}

inline Look look_of(const TreeJob& job, const double* centre, int64_t pulse) {
  Look look;
  look.legs = legs_of(job, centre, pulse);
  if (!job.sector) return look;
  double axis[2][3];
  for (int64_t leg = 0; leg < 2; leg++)
    for (int64_t n = 0; n < 3; n++) axis[leg][n] = job.sector->axis[leg][n * job.pulses + pulse];
  put_axes(centre, job.transmitter + 3 * pulse, job.receiver + 3 * pulse, axis, look);
  return look;
}

// s of (1) of integration.md at offsets d = (x, y, z) from the centre of a tile, with d2 = |d|^2.
inline Lanes place_at(const Look& look, Lanes x, Lanes y, Lanes z, Lanes d2) {
  Lanes s{};
  for (int64_t leg = 0; leg < 2; leg++) {
    const float *w = leg ? look.legs.receiver : look.legs.transmitter, *a = look.axis[leg];
    const Lanes square = x * w[0] + (y * w[1] + (z * w[2] + d2)) + look.legs.squares[leg];
    s += (x * a[0] + (y * a[1] + (z * a[2] + look.along[leg]))) * reciprocal(root(square));
  }
  return s;
}

// ---- The sector over a tile

// Centres c of the sector at the points of a tile's lattice, (4) of integration.md; `smooth`: c is one smooth function
// over the tile; `slack`: largest deviation of c between the points.
struct Centres {
  alignas(64) float at[kLattice];
  bool smooth = true;
  double slack = 0;
};

// (12): largest deviation of s between points from its values at the points: half the square of half their spacing
// times the second derivative, which is at most 2 / sqrt 3 |a| / R^2.
inline double dip_of(const Lattice& lattice, double axis, double range) {
  const double nearest = range - lattice.radius;
  return nearest > 0 ? axis * (0.58 * lattice.bend / nearest + lattice.relief) / nearest : 2;
}

inline double length_of(const double* v, int64_t step) {
  return std::sqrt(v[0] * v[0] + v[step] * v[step] + v[2 * step] * v[2 * step]);
}

// Term of (4) of integration.md that determines c: the sector's centre s_0, the limit s_1 + S' or s_2 - S' of the flown
// range, or their midpoint m; undecided if two terms differ by less than the variation of s between points.
enum CentreTerm { kUndecided, kOwn, kFirstFlown, kLastFlown, kMiddle };

inline CentreTerm centre_term(const SectorJob& sector, const Flown& flown, double margin) {
  const double lowest = flown.first + sector.outer, highest = flown.last - sector.outer;
  const double middle = 0.5 * (flown.first + flown.last);
  if (lowest - margin > middle) return kMiddle;
  if (highest - margin > middle && highest + margin < sector.centre) return kLastFlown;
  if (lowest + margin < middle && lowest - margin > sector.centre) return kFirstFlown;
  if (lowest + margin < middle && lowest + margin < sector.centre && highest - margin > sector.centre) return kOwn;
  return kUndecided;
}

inline Centres centres_of(const TreeJob& job, const TreeTile& tile, const Lattice& lattice) {
  Centres out;
  const SectorJob& sector = *job.sector;
  std::fill(out.at, out.at + kLattice, float(sector.centre));
  if (!sector.ends) return out;
  // (12) for the ends of the flight, which determine s_1 and s_2: largest deviation of s between neighbouring points,
  // and its largest difference between them.
  double step = 0;
  for (int64_t end = 0; end < sector.ends; end++) {
    double dip = 0, slope = 0;
    for (int64_t leg = 0; leg < 2; leg++) {
      const double *antenna = sector.end[leg] + 3 * end, length = length_of(sector.end_axis[leg] + 3 * end, 1);
      const double w[3] = {tile.centre[0] - antenna[0], tile.centre[1] - antenna[1], tile.centre[2] - antenna[2]};
      const double range = length_of(w, 1);
      dip += dip_of(lattice, length, range);
      slope += range > lattice.radius ? length * std::sqrt(lattice.bend) / (range - lattice.radius) : 2;
    }
    out.slack = std::max(out.slack, dip), step = std::max(step, slope);
  }
  // c is smooth if the same term of (4), with the same two ends, determines it at all points.
  CentreTerm term_of_tile = kUndecided;
  int64_t ends_of_tile = 0;
  for (int64_t n = 0; n < lattice.count; n++) {
    double at[3];
    for (int64_t axis = 0; axis < 3; axis++) at[axis] = tile.centre[axis] + lattice.at[axis][n];
    const Flown flown = flown_past(sector, at, 0);
    out.at[n] = float(centre_of(sector, flown));
    const CentreTerm term = centre_term(sector, flown, 2 * out.slack);
    const int64_t ends = term == kOwn ? 0 : 1 + flown.first_end + sector.ends * flown.last_end;
    if (n == 0) term_of_tile = term, ends_of_tile = ends;
    out.smooth &= term != kUndecided && term == term_of_tile && ends == ends_of_tile;
  }
  if (!out.smooth) out.slack = step;  // any term may determine c between points
  return out;
}

// Largest deviation of the axes of a leaf's pulses from the parabola through three of them, sum of both antennas.
inline double turning_of(const TreeJob& job, int64_t begin, int64_t end) {
  const int64_t last = end - 1, middle = (begin + last) / 2, n = job.pulses;
  if (last == begin) return 0;
  double most = 0;
  for (int64_t p = begin; p < end; p++) {
    const double x = double(p - begin), b = double(middle - begin), c = double(last - begin);
    const double shares[3] = {b > 0 ? (x - b) * (x - c) / (b * c) : (c - x) / c,
                              b > 0 ? x * (x - c) / (b * (b - c)) : 0, b > 0 ? x * (x - b) / (c * (c - b)) : x / c};
    double off = 0;
    for (const double* axis : job.sector->axis) {
      double rest[3];
      for (int64_t i = 0; i < 3; i++)
        rest[i] = axis[i * n + p] - shares[0] * axis[i * n + begin] - shares[1] * axis[i * n + middle] -
                  shares[2] * axis[i * n + last];
      off += length_of(rest, 1);
    }
    most = std::max(most, off);
  }
  return most;
}

// Classifies a leaf as inside the sector over the whole tile, outside, or at its edge; at an edge, `slope` is the
// change of the depth (3) of integration.md along the axes of the tile and over the leaf, per half of each.
inline void weigh_by_sector(const TreeJob& job, TreeTile& tile, const Lattice& lattice, const Centres& centres,
                            int64_t leaf) {
  const SectorJob& sector = *job.sector;
  const int64_t begin = leaf * kTreeGroup, end = std::min(begin + kTreeGroup, job.pulses);
  const int64_t three[3] = {begin, (begin + end - 1) / 2, end - 1};
  alignas(64) float place[3][kLattice];
  // s - c at the lattice for three pulses, and the slack (12) for points and pulses between them.
  double slack = centres.slack + kPlaceError, low = 1e9, high = -1e9, dips = 0, nearest = 1e300;
  for (int64_t i = 0; i < 3; i++) {
    const Look look = look_of(job, tile.centre, three[i]);
    for (int64_t n = 0; n < lattice.count; n += kLanes)
      store(place[i] + n, place_at(look, load(lattice.at[0] + n), load(lattice.at[1] + n), load(lattice.at[2] + n),
                                   load(lattice.at[3] + n)) -
                              load(centres.at + n));
    double dip = 0;
    for (int64_t leg = 0; leg < 2; leg++) {
      const double axis = length_of(sector.axis[leg] + three[i], job.pulses), range = look.legs.ranges[leg];
      dip +=
          dip_of(lattice, axis, range) + axis * job.max_track_residual[leaf] / std::max(range - lattice.radius, 1e-3);
      nearest = std::min(nearest, range);
    }
    dips = std::max(dips, dip);
  }
  // Range of s - c, and its changes from point to point and over the leaf.
  double along[3] = {};
  for (int64_t n = 0; n < lattice.count; n++) {
    const int64_t x = n % lattice.side, y = n / lattice.side;
    for (int64_t i = 0; i < 3; i++) {
      const float s = place[i][n];
      low = s >= low ? low : s, high = s <= high ? high : s;
      if (x + 1 < lattice.side) along[0] = std::max(along[0], double(magnitude(place[i][n + 1] - s)));
      if (y + 1 < lattice.side) along[1] = std::max(along[1], double(magnitude(place[i][n + lattice.side] - s)));
    }
    const float before = place[0][n] - place[1][n], behind = place[2][n] - place[1][n];
    along[2] = std::max(along[2], double(std::max(magnitude(before), magnitude(behind))));
    slack = std::max(slack, centres.slack + kPlaceError + double(magnitude(before + behind)) / 8);
  }
  const double turning = turning_of(job, begin, end);
  slack += dips + turning;
  // Including the slack, the whole tile is outside (weight 0) or inside (weight 1), or there is an edge.
  const double width = sector.outer - sector.inner;
  if (low - slack >= sector.outer || high + slack <= -sector.outer)
    tile.variant[leaf] = kNoEcho;
  else if (!(high + slack <= sector.inner && low - slack >= -sector.inner)) {
    float* slope = tile.slope + 3 * leaf;
    const double steps = 0.5 * double(lattice.side - 1);
    slope[0] = float(steps * along[0] / width), slope[1] = float(steps * along[1] / width);
    slope[2] = float(along[2] / width);
    tile.edge[leaf] = 1;
    // The weight changes by at most 1.5 per width of the edge: axes that deviate too far from a parabola exclude smooth
    // weights of virtual pulses.
    if (1.5 * turning / width > kLargest * job.node_error) tile.n_virtual_pulses[leaf] = 1;
    // Centres that change from one term of (4) to another have a kink, which nodes cannot represent.
    if (!centres.smooth || nearest < 2 * lattice.radius) tile.variant[leaf] = kDirectly;
  }
}

// (13): increase of a band, rad, by an edge whose depth changes by `slope` per half axis.
inline double widened(const TreeJob& job, double slope, double band) {
  const double content = std::max(band, 1.0) * job.node_error * job.node_error;
  return std::max(apertura::kTreeWeighted, slope * std::sqrt(std::sqrt(kKink / content)));
}

// ---- Antennas over a tile: polynomials of each pulse

// Sampling points of a tile as offsets from its centre, and matrices from gains at kTerms x kTerms points to a
// polynomial.
struct Sampled {
  double at[kTerms * kTerms][3], between[kBetween * kBetween][3];
  double to_terms[kTerms][kTerms], checked[kBetween][kTerms], curve[kCurve][kTreeGroup];
  explicit Sampled(const TreeTile& tile) {
    double nodes[kTerms], power[kTerms];
    for (int64_t n = 0; n < kTerms; n++) nodes[n] = std::cos(M_PI * (double(n) + 0.5) / kTerms);
    put(tile, nodes, kTerms, at);
    const double places[kBetween] = {-1, -0.65, 0, 0.65, 1};
    put(tile, places, kBetween, between);
    for (int64_t n = 0; n < kTerms; n++) {  // Lagrange polynomials of the nodes in powers
      std::fill(power, power + kTerms, 0.0), power[0] = 1;
      for (int64_t m = 0, degree = 0; m < kTerms; m++) {
        if (m == n) continue;
        degree++;
        for (int64_t k = degree; k >= 0; k--)
          power[k] = ((k ? power[k - 1] : 0) - nodes[m] * power[k]) / (nodes[n] - nodes[m]);
      }
      for (int64_t k = 0; k < kTerms; k++) to_terms[k][n] = power[k];
    }
    for (int64_t n = 0; n < kBetween; n++)
      for (int64_t k = 0; k < kTerms; k++) checked[n][k] = k ? checked[n][k - 1] * places[n] : 1;
    put_curve();
  }
  // Polynomials over the pulses of a leaf, orthonormalised by Gram-Schmidt.
  void put_curve() {
    for (int64_t term = 0; term < kCurve; term++) {
      for (int64_t p = 0; p < kTreeGroup; p++)
        curve[term][p] = term ? curve[term - 1][p] * (2.0 * double(p) - (kTreeGroup - 1)) / (kTreeGroup - 1) : 1;
      for (int64_t below = 0; below <= term; below++) {
        double product = 0;
        for (int64_t p = 0; p < kTreeGroup; p++) product += curve[below][p] * curve[term][p];
        for (int64_t p = 0; p < kTreeGroup; p++)
          curve[term][p] =
              below < term ? curve[term][p] - product * curve[below][p] : curve[term][p] / std::sqrt(product);
      }
    }
  }
  static void put(const TreeTile& tile, const double* places, int64_t count, double (*at)[3]) {
    double value[kBetween][kTreeDegree + 2];
    for (int64_t n = 0; n < count; n++) legendre(places[n], tile.degree, value[n]);
    for (int64_t n = 0; n < count * count; n++) offset_at(tile, value[n % count], value[n / count], at[n]);
  }
};

// Gain of both antennas of one pulse at `count` points.
inline void gains_at(const TreeJob& job, const TreeTile& tile, int64_t pulse, const double (*at)[3], int64_t count,
                     float* out) {
  std::fill(out, out + count, 1.0f);
  for (int64_t leg = 0; leg < 2; leg++) {
    const BeamJob* beam = job.beam[leg];
    if (!beam) continue;
    const double* antenna = (leg ? job.receiver : job.transmitter) + 3 * pulse;
    double axes[3][3], middle[3] = {};
    for (int64_t a = 0; a < 3; a++)
      for (int64_t n = 0; n < 3; n++) {
        axes[a][n] = beam->axes[(3 * a + n) * job.pulses + pulse];
        middle[a] += axes[a][n] * (tile.centre[n] - antenna[n]);
      }
    alignas(64) float place[2][32];
    for (int64_t i = 0; i < count; i++) {
      float v[3];
      for (int64_t a = 0; a < 3; a++)
        v[a] = float(middle[a] + axes[a][0] * at[i][0] + axes[a][1] * at[i][1] + axes[a][2] * at[i][2]);
      place[0][i] = azimuth_place(*beam, v[0], v[1]), place[1][i] = elevation_place(*beam, v[0], v[1], v[2]);
    }
    for (int64_t cut = 0; cut < 2; cut++)
      for (int64_t i = 0; i < count; i++) out[i] *= look_up(*beam, cut, place[cut][i]);
  }
}

// Returns true if the ball around a tile may touch the cone about the boresight that contains the pattern, and the
// elevations of the pattern.
inline bool may_touch(const TreeJob& job, const TreeTile& tile, double radius, int64_t pulse) {
  for (int64_t leg = 0; leg < 2; leg++) {
    const BeamJob* beam = job.beam[leg];
    if (!beam) continue;
    const double* antenna = (leg ? job.receiver : job.transmitter) + 3 * pulse;
    double v[3] = {}, square = 0;
    for (int64_t n = 0; n < 3; n++) {
      const double w = tile.centre[n] - antenna[n];
      for (int64_t a = 0; a < 3; a++) v[a] += w * beam->axes[(3 * a + n) * job.pulses + pulse];
      square += w * w;
    }
    const double range = std::sqrt(square);
    if (radius >= range) continue;
    double edge[2];
    for (int64_t cut = 0; cut < 2; cut++)
      edge[cut] = std::cos(std::max(std::fabs(beam->first_rad[cut]), std::fabs(last_rad(*beam, cut))));
    const double cone = std::acos(edge[0] < 0 ? edge[0] : edge[0] * std::max(edge[1], 0.0));
    const double near = std::asin(radius / range) + 1e-6, off = std::acos(std::max(-1.0, std::min(1.0, v[0] / range)));
    const double elevation = std::asin(std::max(-1.0, std::min(1.0, v[2] / range)));
    if (off - near >= cone || elevation + near <= beam->first_rad[1] || elevation - near >= last_rad(*beam, 1))
      return false;
  }
  return true;
}

// Largest deviation of a leaf's weights from a polynomial over its pulses, over all sampling points.
inline float jumps_of(const Sampled& sampled, const float (*gain)[kTerms * kTerms]) {
  double most = 0;
  for (int64_t place = 0; place < kTerms * kTerms; place++) {
    double share[kCurve] = {};
    for (int64_t term = 0; term < kCurve; term++)
      for (int64_t p = 0; p < kTreeGroup; p++) share[term] += sampled.curve[term][p] * gain[p][place];
    for (int64_t p = 0; p < kTreeGroup; p++) {
      double rest = gain[p][place];
      for (int64_t term = 0; term < kCurve; term++) rest -= share[term] * sampled.curve[term][p];
      most = std::max(most, std::fabs(rest));
    }
  }
  return float(most);
}

// Fits polynomials to the gains of a leaf's pulses; a leaf is summed directly if their error exceeds kLargest times the
// node error, or if a beam ends in the tile.
inline void weigh_by_antennas(const TreeJob& job, TreeTile& tile, const Lattice& lattice, const Sampled& sampled,
                              int64_t leaf) {
  const int64_t begin = leaf * kTreeGroup, count = std::min(begin + kTreeGroup, job.pulses) - begin;
  constexpr int64_t kPlaces = kTerms * kTerms;
  float gain[kTreeGroup][kPlaces], most = 0;
  const double far = std::sqrt(*std::max_element(lattice.at[3], lattice.at[3] + lattice.count)) + lattice.relief;
  // Gains at the kTerms x kTerms points; `whole`: no beam ends between them.
  bool illuminated = false, whole = true;
  for (int64_t p = 0; p < count; p++) {
    gains_at(job, tile, begin + p, sampled.at, kPlaces, gain[p]);
    int64_t dark = 0;
    for (int64_t n = 0; n < kPlaces; n++) dark += gain[p][n] == 0, most = std::max(most, gain[p][n]);
    whole &= dark == 0 || dark == kPlaces;
    illuminated = illuminated || may_touch(job, tile, far, begin + p);
  }
  if (!illuminated) {
    tile.variant[leaf] = kNoEcho;
    return;
  }
  const float limit = float(kLargest * job.node_error) * most;
  const bool each = count < kTreeGroup || jumps_of(sampled, gain) > limit;  // excludes virtual pulses
  // Polynomials of degree 3 along both axes, and their largest error at kBetween x kBetween points.
  float worst = 0;
  for (int64_t p = 0; p < count; p++) {
    double half[kTerms][kTerms] = {};
    float* terms = tile.weight + (begin + p) * kTreeWeights;
    for (int64_t b = 0; b < kTerms; b++)
      for (int64_t a = 0; a < kTerms; a++)
        for (int64_t n = 0; n < kTerms; n++) half[b][a] += sampled.to_terms[a][n] * gain[p][kTerms * b + n];
    for (int64_t b = 0; b < kTerms; b++)
      for (int64_t a = 0; a < kTerms; a++) {
        double sum = 0;
        for (int64_t n = 0; n < kTerms; n++) sum += sampled.to_terms[b][n] * half[n][a];
        terms[kTerms * b + a] = float(sum);
      }
    if (!each && p % kChecked) continue;  // weights that jump are checked for every pulse
    float there[kBetween * kBetween];
    gains_at(job, tile, begin + p, sampled.between, kBetween * kBetween, there);
    for (int64_t n = 0; n < kBetween * kBetween; n++) {
      double value = 0;
      const double *xi = sampled.checked[n % kBetween], *eta = sampled.checked[n / kBetween];
      for (int64_t b = 0; b < kTerms; b++)
        for (int64_t a = 0; a < kTerms; a++) value += eta[b] * xi[a] * terms[kTerms * b + a];
      worst = std::max(worst, magnitude(float(value) - there[n]));
    }
  }
  if (!whole || !(most > 0) || !(worst <= limit)) tile.variant[leaf] = kDirectly;
  if (each) tile.n_virtual_pulses[leaf] = 1;
}

// Classifies the leaves of a tile that are to be summed by tree by their weights.
inline void weigh_leaves(const TreeJob& job, TreeTile& tile, const Lattice& lattice) {
  const bool antennas = job.beam[0] || job.beam[1];
  if (!antennas && !job.sector) return;
  const std::unique_ptr<Sampled> sampled(antennas ? new Sampled(tile) : nullptr);
  const Centres centres = job.sector ? centres_of(job, tile, lattice) : Centres();
  for (int64_t leaf = 0; leaf * kTreeGroup < job.pulses; leaf++) {
    if (tile.variant[leaf] == apertura::kByTree && job.sector) weigh_by_sector(job, tile, lattice, centres, leaf);
    if (tile.variant[leaf] == apertura::kByTree && antennas) weigh_by_antennas(job, tile, lattice, *sampled, leaf);
  }
}

// ---- Weights at the nodes of a leaf

// Gain of both antennas at a vector of nodes, from a polynomial.
inline Lanes weight_at(const float* w, Lanes xi, Lanes eta) {
  Lanes along[4];
  for (int64_t b = 0; b < 4; b++) along[b] = w[4 * b] + xi * (w[4 * b + 1] + xi * (w[4 * b + 2] + xi * w[4 * b + 3]));
  return along[0] + eta * (along[1] + eta * (along[2] + eta * along[3]));
}

// Gains of one pulse at the nodes of a leaf; null if all are 1.
inline const float* node_gains(const TreeJob& job, const LeafNodes& leaf, const Look& look, bool edge,
                               const float* weight, Floats& out) {
  if (!edge && !weight) return nullptr;
  const int64_t count = leaf.at.count;
  out.resize(size_t(count));
  const float* x = leaf.at.x(0);
  const Lanes whole = splat(1);
  float outer = 0, per_width = 0, centre = 0;
  if (edge)
    outer = float(job.sector->outer), per_width = float(1 / (job.sector->outer - job.sector->inner)),
    centre = float(job.sector->centre);
  for (int64_t n = 0; n < count; n += kLanes) {
    Lanes gain = weight ? weight_at(weight, load(&leaf.xi[n]), load(&leaf.eta[n])) : whole;
    if (edge) {
      const Lanes s =
          place_at(look, load(x + n), load(x + count + n), load(x + 2 * count + n), load(x + 3 * count + n)) -
          (leaf.centre.empty() ? splat(centre) : load(&leaf.centre[n]));
      const Lanes depth = within_unit((outer - magnitude(s)) * per_width);
      gain *= depth * depth * (3.0f - 2.0f * depth);
    }
    store(&out[n], gain);
  }
  return out.data();
}

}  // namespace
