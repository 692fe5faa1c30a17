"""Pulses that contribute to a pixel: number of looks, aperture centre, illumination."""

from dataclasses import replace

import numpy as np
import pytest
from pyproj import Geod, Transformer
from scenes import monostatic, straight_track
from scipy.interpolate import RegularGridInterpolator

from apertura.core.antenna.beam import Beam, Beams, gaussian_cut
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.geodesy import frame_from_map
from apertura.core.geometry.sector import Sector
from apertura.core.scene.angles import bistatic_angle_deg, incidence_deg
from apertura.core.scene.grid import SceneGrid
from apertura.core.scene.looks import BLOCK_PX, SPREAD, Lattice, Looks
from apertura.core.scene.terrain import FlatGround

GROUND = FlatGround(0.0)
GRID = SceneGrid("local", -60.0, 70.0, 0.25, (200, 480))
FLOWN = monostatic(straight_track(6000, length_m=150.0))


def sideways(pulses, *, beamwidth_deg=(30.0, 8.0)):
    """Return a beam directed to the north and 30° downwards that ends at -20 dB."""
    down = np.radians(30)
    axes = np.array([[0, np.cos(down), -np.sin(down)], [1, 0, 0], [0, np.sin(down), np.cos(down)]])
    cuts = [gaussian_cut(width, cutoff_db=-20.0, limit_rad=np.pi / 2) for width in beamwidth_deg]
    return Beam(np.broadcast_to(axes, (pulses, 3, 3)), *cuts[0], *cuts[1])


SECTOR = Sector.of(FLOWN, chord_m=2.0, centre=0.0, half=0.2)
WEIGHED = {
    "sector": Beams(sector=SECTOR),
    "beam": Beams(sideways(len(FLOWN)), sideways(len(FLOWN))),
    "both": Beams(sideways(len(FLOWN)), None, SECTOR),
    "wide": Beams(sideways(len(FLOWN), beamwidth_deg=(30.0, 60.0)), None, SECTOR),
}


def tiles(looks):
    return list(looks.grid.tiles(BLOCK_PX))


def assembled(looks, of):
    values = np.empty(looks.grid.shape)
    for tile in tiles(looks):
        values[tile] = of(tile)
    return values


def some_pixels(count=400):
    rows, columns = np.random.default_rng(1).integers(0, GRID.shape, (count, 2)).T
    return rows, columns, GROUND.positions_at(GRID, rows, columns)


def every_weight(beams, points):
    parts = [slice(first, first + 250) for first in range(0, len(FLOWN), 250)]
    return np.concatenate([beams[part].weight(FLOWN[part], points) for part in parts])


@pytest.mark.parametrize("kind", ["sector", "wide"])
def test_interpolated_looks_match_the_exact_ones(kind):
    looks = Looks.of(GRID, GROUND, FLOWN, WEIGHED[kind], threads=2)
    rows, columns, points = some_pixels()
    weight = every_weight(WEIGHED[kind], points)
    exact = weight.sum(axis=0) ** 2 / np.maximum((weight**2).sum(axis=0), 1e-30)
    found = assembled(looks, looks.effective)[rows, columns]
    inside = exact > 0.5 * exact.max()
    assert inside.mean() > 0.3
    assert np.abs(found / np.maximum(exact, 1) - 1)[inside].max() < 0.01


def of_sums(looks):
    """Return S₁²/S₂ with both sums bilinear between nodes, in float64."""
    whole = tuple(slice(0, size) for size in looks.grid.shape)
    total, squares = (looks.lattice.between(sums.astype(float), whole) for sums in (looks.total, looks.squares))
    return total**2 / squares


@pytest.mark.parametrize("step", [0.019, 0.021])
@pytest.mark.parametrize("growth", [1.0, 0.55, 1.9])
def test_looks_are_bilinear_only_where_both_sums_change_alike(step, growth):
    """The largest tolerated change gives a non-zero error of at most 0.08 %; above it the sums are interpolated."""
    looks = Looks.of(GRID, GROUND, FLOWN, None)
    row, column = np.ogrid[: looks.lattice.shape[0], : looks.lattice.shape[1]]
    total = 1e3 * growth ** (row % 2) * np.ones(column.shape)
    squares = total * (1 + step * (column % 2))
    changed = replace(looks, total=total.astype(np.float32), squares=squares.astype(np.float32))
    found, exact = assembled(changed, changed.effective), of_sums(changed)
    error = np.abs(found / exact - 1).max()
    if step > 0.02:
        assert error < 1e-6
    else:
        assert 1e-5 < error < 8e-4


def test_looks_at_an_edge_use_the_sums():
    """Looks are not interpolated bilinearly if a sum decreases by more than half between nodes, or to zero."""
    looks = Looks.of(GRID, GROUND, FLOWN, None)
    total = np.full(looks.lattice.shape, 1e3, np.float32)
    total[:, 3:] *= 0.45
    squares = 1.015 ** np.arange(total.shape[1], dtype=np.float32) * total
    steep = replace(looks, total=total, squares=squares)
    error = np.abs(assembled(steep, steep.effective) / of_sums(steep) - 1)
    assert error[:, :BLOCK_PX].max() < 1e-6
    assert 1e-5 < error[:, BLOCK_PX:].max() < 1e-4  # beyond the drop, both sums change equally
    dark = np.arange(total.shape[1]) >= 3
    ends = replace(looks, total=np.where(dark, 0, total), squares=np.where(dark, 0, squares))
    last_lit = assembled(ends, ends.effective)[:, 3 * looks.lattice.pitch_px - 1]  # looks of the last node with pulses
    assert np.abs(last_lit / (1e3 / 1.015**2) - 1).max() < 1e-6


def test_interpolation_uses_the_nodes_of_rows_and_columns():
    lattice, window = Lattice.of((300, 500), 32), (slice(280, 300), slice(280, 300))
    found = lattice.between(np.subtract.outer(lattice.nodes[0], 1000.0 * lattice.nodes[1]), window)
    assert np.allclose(found, np.subtract.outer(np.arange(280, 300), 1000.0 * np.arange(280, 300)), atol=1e-9)


def test_interpolation_keeps_float32_and_float64():
    lattice, rng = Lattice.of((300, 500), 32), np.random.default_rng(2)
    values, window = 50 + rng.random((*lattice.shape, 2)), (slice(100, 300), slice(7, 450))
    exact = lattice.between(values, window)
    found = lattice.between(values.astype(np.float32), window)
    assert (exact.dtype, found.dtype) == (np.float64, np.float32)
    assert np.abs(found / exact - 1).max() < 3e-7
    rows, columns = np.meshgrid(*(np.arange(at.start, at.stop) for at in window), indexing="ij")
    by_scipy = RegularGridInterpolator(lattice.nodes, values)(np.stack([rows, columns], -1))
    assert np.allclose(exact, by_scipy, rtol=1e-12)


@pytest.mark.parametrize("kind", ["sector", "beam"])
def test_pulses_of_a_node_have_half_weight_and_even_spread(kind):
    looks = Looks.of(GRID, GROUND, FLOWN, WEIGHED[kind])
    rows, columns = np.meshgrid(*looks.lattice.nodes, indexing="ij")
    weight = np.abs(every_weight(WEIGHED[kind], GROUND.positions_at(GRID, rows.ravel(), columns.ravel())))
    most = weight.max(axis=0)
    lit = np.flatnonzero(most > 0.5 * most.max())
    assert lit.size > 30
    for node in lit.tolist():
        pulses, counted = looks.pulses.reshape(-1, SPREAD)[node], np.flatnonzero(weight[:, node] >= most[node] / 2)
        assert (weight[pulses, node] > 0.45 * most[node]).all()
        place = np.searchsorted(counted, pulses) / len(counted)
        assert np.abs(place - np.linspace(0, 1, SPREAD)).max() < 0.06


def test_looks_are_the_effective_number_of_pulses():
    looks = Looks.of(GRID, GROUND, FLOWN, WEIGHED["sector"])
    middle = looks.effective((slice(0, 200), slice(0, 256)))[100, 240]
    weight = every_weight(WEIGHED["sector"], GROUND.positions_at(GRID, [100], [240]))
    assert (weight == 1).sum() < middle < (weight > 0).sum()
    assert (Looks.of(GRID, GROUND, FLOWN, None).effective((slice(0, 8), slice(0, 8))) == len(FLOWN)).all()


@pytest.mark.quick("sector")
@pytest.mark.parametrize("kind", WEIGHED)
def test_illumination_is_exact_at_every_pixel(kind):
    looks = Looks.of(GRID, GROUND, FLOWN, WEIGHED[kind], threads=2)
    illuminated = assembled(looks, looks.illuminated).astype(bool)
    rows, columns, points = some_pixels(1500)
    assert np.array_equal(illuminated[rows, columns], (every_weight(WEIGHED[kind], points) != 0).any(axis=0))
    if kind in {"sector", "wide"}:
        assert illuminated.all()
        return
    # boundaries between dark and illuminated pixels of a row
    edge = np.argwhere(illuminated[:, 1:] != illuminated[:, :-1])[::7]
    points = GROUND.positions_at(GRID, *np.concatenate([edge, edge + [0, 1]]).T)
    at_edge = np.concatenate([illuminated[tuple(edge.T)], illuminated[tuple((edge + [0, 1]).T)]])
    assert np.array_equal(at_edge, (every_weight(WEIGHED[kind], points) != 0).any(axis=0))
    assert not illuminated.all()
    assert (assembled(looks, looks.effective)[~illuminated] == 0).all()


@pytest.mark.parametrize("beams", [None, Beams(sector=Sector.of(FLOWN, chord_m=2.0, centre=0.2, half=0.1))])
def test_aperture_centre_is_the_closest_approach(beams):
    """The centre is abeam of a straight track, or behind if the sector is squinted by s = 2 sin(squint)."""
    looks, (rows, columns, points) = Looks.of(GRID, GROUND, FLOWN, beams), some_pixels()
    east = assembled(looks, lambda tile: looks.centre(tile)[0][..., 0])[rows, columns]
    squint = 0.0 if beams is None else np.arcsin(0.2)
    expected = points[:, 0] - np.hypot(points[:, 1], 10.0) * np.tan(squint)
    within = np.abs(expected) < 74
    assert within.mean() > 0.8
    assert np.abs(east - expected)[within].max() < 0.02


@pytest.mark.parametrize("passes", [1, 2])
def test_interpolated_angles_over_level_terrain_are_accurate(passes):
    """Errors are within 0.006° between nodes at 1/48 of the range; where the nearest pass changes, pixels are exact."""
    along = np.linspace(-80, 80, 600)
    tx = np.concatenate([np.stack([along, 0 * along + y, 0 * along + 200], -1) for y in (0.0, 860.0)[:passes]])
    grid = SceneGrid("local", -60.0, 470.0, 0.25, (300, 300))
    looks = Looks.of(grid, GROUND, Aperture(tx, tx + [30.0, 0, 5]), None)
    assert looks.lattice.pitch_px > 16
    places, normal = GROUND.positions(grid), np.array([0.0, 0, 1])
    of_tile = [looks.centre(tile) for tile in tiles(looks)]
    centre = [np.empty((*grid.shape, 3)) for _ in range(2)]
    for tile, found in zip(tiles(looks), of_tile, strict=True):
        centre[0][tile], centre[1][tile] = found
    incidence = assembled(looks, looks.incidence_deg)
    assert np.abs(incidence - incidence_deg(places, normal, centre[0])).max() < 0.006
    across = assembled(looks, looks.bistatic_angle_deg)
    assert np.abs(across - bistatic_angle_deg(places, *centre)).max() < 0.006
    assert np.ptp(across) > 0.2


def test_aperture_centre_is_not_interpolated_between_passes():
    east = np.linspace(-60, 60, 800)
    south, north = (np.stack([east, np.full(800, y), np.full(800, 10.0)], -1) for y in (0.0, 90.0))
    track = np.concatenate([south, north])
    looks = Looks.of(GRID, GROUND, Aperture(track, track), None)
    passed = assembled(looks, lambda tile: looks.centre(tile)[1][..., 1])
    assert set(np.unique(passed.round(6))) == {0.0, 90.0}
    assert (passed[:80] == 90).all()  # north of 50 m; the boundary is at 45 m
    assert (passed[120:] == 0).all()


@pytest.mark.parametrize("crs", ["EPSG:32632", "local"])
@pytest.mark.parametrize("apart_m", [0.0, 40.0])
def test_line_of_sight_gives_the_path_change_of_a_displacement(crs, apart_m):
    """A displacement d changes half the total path by -cos(β/2) d·u (layers.md, eq. 1a).

    The displacements are 0.1 mm along the axes of geographic coordinates, by pyproj.
    """
    west_m, north_m = (570600.0, 5363800.0) if crs != "local" else (0.0, 0.0)
    grid = SceneGrid(crs, west_m, north_m, 1.0, (60, 80))
    along = np.linspace(-50, 150, 900)

    def flown(across_m):
        if crs == "local":
            return np.stack([along, np.full(900, across_m), np.full(900, 700.0)], -1)
        return frame_from_map(crs, west_m + along, np.full(900, north_m + across_m), np.full(900, 700.0))

    looks = Looks.of(grid, FlatGround(620.0), Aperture(flown(40.0), flown(40.0 + apart_m)), None)
    tile = (slice(0, 60), slice(0, 80))
    sight, angle = looks.line_of_sight_enu(tile), np.radians(looks.bistatic_angle_deg(tile))
    assert np.allclose(np.linalg.norm(sight, axis=-1), 1, atol=1e-9)
    assert (sight[..., 1] > 0).all()  # the track is north of the scene
    place, centre = FlatGround(620.0).positions(grid), looks.centre(tile)
    half_path = np.stack([np.linalg.norm(antenna - place, axis=-1) for antenna in centre]).sum(axis=0) / 2
    assert np.allclose(looks.slant_ranges_m(tile).mean(axis=-1), half_path, atol=1e-9)
    for axis, moved in enumerate(displaced(place, 1e-4, crs)):
        changed = np.stack([np.linalg.norm(antenna - moved, axis=-1) for antenna in centre]).sum(axis=0) / 2
        assert np.abs((changed - half_path) / 1e-4 + np.cos(angle / 2) * sight[..., axis]).max() < 1e-4
    assert (np.cos(angle / 2).min() < 0.99) == (apart_m > 0)


def displaced(place, by_m, crs):
    """Return positions displaced to the east, to the north and upwards."""
    if crs == "local":
        return [place + by_m * axis for axis in np.eye(3)]
    to_geodetic = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    longitude, latitude, height = to_geodetic.transform(*np.moveaxis(place, -1, 0))
    geod = Geod(ellps="WGS84")
    moved = []
    for azimuth in (90.0, 0.0):  # 1 m, so that the rounding of geographic coordinates has no effect
        east, north, _ = geod.fwd(longitude, latitude, np.full(longitude.shape, azimuth), np.ones(longitude.shape))
        ahead = np.stack(to_geodetic.transform(east, north, height, direction="INVERSE"), -1) - place
        moved.append(place + by_m * ahead / np.linalg.norm(ahead, axis=-1, keepdims=True))
    above = np.stack(to_geodetic.transform(longitude, latitude, height + by_m, direction="INVERSE"), -1)
    return [*moved, above]
