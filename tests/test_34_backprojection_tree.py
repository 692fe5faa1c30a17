"""Tree engine compared with the double sum: choice of tree or direct kernel, bit-identical results."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scenes import compiled, decibels, ecef, error_db, observed, pixel_grid, scatter, swaying_beam
from tree_flights import WAVENUMBERS, counted, flown, formed, heard, seen, setting, shaken

from apertura.common.constants import SPEED_OF_LIGHT_M_S as C
from apertura.core.antenna.beam import Beam, Beams
from apertura.core.backprojection.engines import native, pieces, reference, tree
from apertura.core.backprojection.engines.tree_geometry import nodes, nodes_for, supports, surfaces_of, weights
from apertura.core.backprojection.engines.tree_inputs import roughness, weighed
from apertura.core.backprojection.engines.tree_prediction import view_of_tile, widened_rad
from apertura.core.geometry.aperture import Aperture
from apertura.core.geometry.sector import Sector, edge

pytestmark = compiled


@pytest.fixture(scope="module", params=[True, False], ids=["bistatic", "monostatic"])
def flights(request):
    return flown(pixel_grid(70, 90), pulses=300, bistatic=request.param)


@pytest.fixture(scope="module")
def plain():
    return flown(pixel_grid(70, 90), pulses=300)


@pytest.mark.slow
@pytest.mark.parametrize("nodes_db", [-50, -74, -98])
def test_every_instruction_set_meets_the_predicted_error(isa, flights, nodes_db):
    image, share = formed(flights, nodes_db=nodes_db)
    assert tree.instruction_set() == isa
    assert share.tolist() == [1, 0, 0]
    predicted_db = setting(flights, nodes_db=nodes_db).error_db
    assert error_db(flights.scene, flights.pixels, image) <= predicted_db + 3
    assert nodes_db + 3 < predicted_db < max(nodes_db + 13, -83)  # limit of range cells and float32


def test_tiles_are_bit_identical_to_the_whole_image(isa, plain):
    chosen, points = setting(plain, nodes_db=-74), ecef(plain.pixels)
    trees = tree.prepare(plain.profiles, **chosen.options)
    whole = tree.form(trees, points, **chosen.form_options)
    windows = pieces("tree", whole.shape, chosen.form_options)
    assert len(windows) == 4
    for window in windows:
        alone = tree.form(trees, points[window], **chosen.form_options)
        np.testing.assert_array_equal(alone.view(np.uint32), whole[window].view(np.uint32))


def test_threads_give_bit_identical_images(plain):
    chosen, points = setting(plain, nodes_db=-74), ecef(plain.pixels)
    trees = tree.prepare(plain.profiles, **chosen.options)
    with ThreadPoolExecutor(2) as pool:
        images = list(pool.map(lambda _: tree.form(trees, points, **chosen.form_options), range(4)))
    assert all(np.array_equal(image, images[0]) for image in images)


def test_pixels_without_position_are_nan_and_others_unchanged(plain):
    pixels, (whole, _) = plain.pixels.copy(), formed(plain)
    pixels[3, 5] = np.nan
    image, share = formed(plain, pixels)
    assert np.argwhere(np.isnan(image)).tolist() == [[3, 5]]
    tile = pieces("tree", image.shape, {"side_px": 64})[0]
    # Only the tile of the undefined pixel uses the direct kernel.
    assert share[1] == pytest.approx(image[tile].size / image.size)
    elsewhere = np.ones(image.shape, bool)
    elsewhere[tile] = False
    assert np.array_equal(image[elsewhere], whole[elsewhere])
    image[3, 5] = whole[3, 5]
    assert decibels(image - whole, whole) <= -65


def test_tiles_at_the_end_of_profiles_use_the_direct_kernel():
    """Profiles end inside the scene; the step at this end is not band-limited and requires the direct kernel."""
    flight = flown(pixel_grid(130, 200, spacing_m=0.15), pulses=128)
    whole, _ = formed(flight)
    flight.profiles = replace(flight.profiles, samples=flight.profiles.samples[:, :100])
    image, share = formed(flight)
    cells = tree.prepare(flight.profiles).direct_setting(-74).oversampling
    direct = native.form(native.prepare(flight.profiles, oversampling=cells), ecef(flight.pixels))
    assert 0.2 < share[0] < 0.8
    assert share[1] > 0.2
    assert decibels(image - direct, direct) <= -62
    assert decibels(whole - direct, direct) > -20  # the truncation has an effect


def test_tiles_beyond_all_profiles_are_skipped(plain):
    far = pixel_grid(40, 40, range_m=60.0)
    image, share = formed(plain, far)
    assert share.tolist() == [0, 0, 1]
    assert not image.any()


@pytest.mark.slow
@pytest.mark.parametrize("jitter_m", [0.0, 1e-3, 1e-2])
def test_pulses_off_a_smooth_track_are_not_presummed(plain, jitter_m):
    """64 pulses of a smooth track are presummed; with white noise of 1 mm at 12 m range, pulses are not presummed."""
    white = jitter_m * np.random.default_rng(8).standard_normal((2, 300, 3))
    true = plain.scene
    scene = observed(scatter(plain.pixels), true.tx + white[0], true.rx + white[1], true.carrier_hz)
    shaken = seen(scene, plain.pixels)
    virtual = counted(shaken.aperture[:256], ecef(plain.pixels[:35, :45])).virtual
    assert 5 <= virtual <= 28 if not jitter_m else virtual == 0
    image, share = formed(shaken)
    assert share[0] == 1
    assert error_db(scene, plain.pixels, image) <= -64


@pytest.mark.slow
@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("jitter_m", [3e-4, 3e-3])
def test_presumming_on_a_rough_track_has_the_predicted_error(plain, jitter_m, together):
    """Profiles of noise, without correlation between pulses, are the worst case."""
    flight = heard(shaken(plain, jitter_m, together=together))
    images = [formed(flight, nodes_db=-86, presum_db=presum_db)[0] for presum_db in (-100, -40)]
    predictions = [
        counted(flight.aperture[:256], ecef(plain.pixels[window]), presum_db=-40)
        for window in pieces("tree", images[0].shape, {"side_px": 64})
    ]
    predicted_db = 10 * np.log10(np.mean([tile.presum_rad**2 for tile in predictions]))
    assert predicted_db - 7 <= decibels(images[1] - images[0], images[0]) <= predicted_db


@pytest.mark.slow
@pytest.mark.parametrize(("height_m", "nodes_db", "layers"), [(0.02, -50, 3), (0.05, -74, 4), (0.3, -62, 7)])
def test_rough_terrain_is_interpolated_between_height_layers(height_m, nodes_db, layers):
    """Eq. 11: relief between pixels is summed by trees on height layers, or by the direct kernel with fewer layers."""
    rough = pixel_grid(70, 90)
    rough[..., 2] += height_m * np.random.default_rng(6).uniform(-1, 1, rough.shape[:2])
    flight = flown(rough, pulses=300)
    image, share = formed(flight, nodes_db=nodes_db, height_layers=32, side_px=128)
    assert share.tolist() == [1, 0, 0]
    assert error_db(flight.scene, rough, image) <= setting(flight, nodes_db=nodes_db, height_layers=32).error_db + 3
    needed = next(
        most for most in range(33) if formed(flight, nodes_db=nodes_db, height_layers=most, side_px=128)[1][0]
    )
    assert needed == layers


@pytest.mark.slow
def test_rough_terrain_uses_the_direct_kernel():
    rough = pixel_grid(70, 90)
    rough[..., 2] += 0.02 * np.random.default_rng(6).standard_normal(rough.shape[:2])
    flight = flown(rough, pulses=300)
    image, share = formed(flight)
    assert share.tolist() == [0, 1, 0]
    assert error_db(flight.scene, rough, image) <= -70


@pytest.mark.slow
def test_rolling_terrain_uses_the_tree():
    rolling = pixel_grid(70, 90)
    rolling[..., 2] = 0.15 * np.sin(rolling[..., 0]) * np.cos(1.3 * rolling[..., 1])
    flight = flown(rolling, pulses=300)
    image, share = formed(flight)
    assert share.tolist() == [1, 0, 0]
    assert error_db(flight.scene, rolling, image) <= setting(flight, nodes_db=-74).error_db + 3


@pytest.mark.slow
@pytest.mark.parametrize(("carrier_hz", "spacing_m", "rough_m"), [(1.2e9, 0.05, 6e-4), (10e9, 0.01, 5e-4)])
def test_pixels_off_their_surface_have_the_predicted_error(carrier_hz, spacing_m, rough_m):
    """Eq. 9: height noise that the tree accepts at -50 dB adds delay error at 1 GHz and phase error at 10 GHz."""
    pixels = pixel_grid(60, 60, spacing_m=spacing_m)
    rough, flight = pixels.copy(), flown(pixels, pulses=128, carrier_hz=carrier_hz)
    rough[..., 2] += rough_m * np.random.default_rng(6).standard_normal((60, 60))
    (surface,) = surfaces_of(ecef(rough), [(slice(0, 60), slice(0, 60))])
    powers = []
    for positions in (rough, pixels):
        image, share = formed(flight, positions, nodes_db=-50)
        assert share[0] == 1
        powers.append(10 ** (error_db(flight.scene, positions, image, 600) / 10))
    wave = WAVENUMBERS | {"wavenumber_rad_m": 2 * np.pi * carrier_hz / C}
    predicted_db = 10 * np.log10(roughness(flight.aperture, surface, **wave))
    assert 10 * np.log10(powers[0] - powers[1]) == pytest.approx(predicted_db, abs=1)


@pytest.mark.quick("3.0-0.15-0")
@pytest.mark.parametrize(("range_m", "spacing_m", "levels"), [(12.0, 0.05, 2), (5.0, 0.08, 1), (3.0, 0.15, 0)])
def test_near_tile_uses_smaller_subapertures_or_the_direct_kernel(range_m, spacing_m, levels):
    """Near tiles need more nodes per subaperture: above 128 nodes, the tree has fewer levels or is not used."""
    pixels = pixel_grid(100, 100, spacing_m=spacing_m, range_m=range_m)
    flight = flown(pixels, pulses=256, carrier_hz=4e9, range_m=range_m)
    image, share = formed(flight, side_px=128)
    assert len(counted(flight.aperture, ecef(pixels), carrier_hz=4e9).nodes) == levels
    assert share.tolist() == [levels > 0, levels == 0, 0]
    assert error_db(flight.scene, pixels, image) <= -62


def weighted_error_db(flight, image, beams):
    sampled = np.random.default_rng(3).integers(0, image.size, 100)
    truth = reference.form(flight.scene.history(), ecef(flight.pixels).reshape(-1, 3)[sampled][None], beams=beams)[0]
    return decibels(image.ravel()[sampled] - truth, truth)


@pytest.mark.parametrize("sway_deg", [0.0, 3.0])
def test_smooth_weights_are_applied_at_the_leaves(isa, plain, sway_deg):
    """This also holds if weights jump between pulses, which are then not presummed."""
    beams = Beams(swaying_beam(plain.scene.tx, (12, 1, 0), 30, sway_deg=sway_deg))
    image, share = formed(plain, beams=beams)
    assert share.tolist() == [1, 0, 0]
    assert weighted_error_db(plain, image, beams) <= -64
    assert decibels(image - formed(plain)[0], image) > -30  # the weight has an effect


def sector_of(flight, half, centre=0.02):
    """Return beams of a sector; a sector far ahead of the flight is centred on the nearest pulse of each point."""
    sector = Sector.of(flight.aperture, chord_m=1.2, centre=centre, half=half)
    if centre < 0.3:
        return Beams(None, None, sector)
    return Beams(None, None, sector.following(flight.aperture, ecef(flight.pixels)[::10, ::10].reshape(-1, 3)))


@pytest.mark.quick("*-0.02-0.1--74", "*-0.7-0.2--74")
@pytest.mark.parametrize("nodes_db", [-50, -74])
@pytest.mark.parametrize(("centre", "half"), [(0.02, 0.25), (0.02, 0.1), (0.7, 0.2), (0.7, 0.05)])
def test_sector_edges_use_the_tree(isa, plain, centre, half, nodes_db):
    """This also holds with a separate centre for each point; pulses beyond the edges are skipped."""
    beams = sector_of(plain, half, centre)
    assert (beams.sector.ends is None) == (centre < 0.3)
    image, share = formed(plain, beams=beams, nodes_db=nodes_db)
    assert share[1] == 0
    assert share[0] > 0.2
    assert share[2] > 0.2 or half >= 0.2
    assert weighted_error_db(plain, image, beams) <= setting(plain, nodes_db=nodes_db).error_db
    assert decibels(image - formed(plain, nodes_db=nodes_db)[0], image) > -25  # the sector has an effect


@pytest.mark.slow
@pytest.mark.parametrize("relief_m", [0.0, 0.4])
@pytest.mark.parametrize("antenna", [False, True])
def test_weights_of_a_whole_tile_hold_at_every_pixel(antenna, relief_m):
    """Eq. 12 for random tiles of a swaying flight: the weight is 1 inside a sector and 0 for skipped pulses."""
    generator, along = np.random.default_rng(3), np.linspace(-60, 60, 3200)
    sway = np.stack([along, 2 * np.sin(along / 9), 20 + np.cos(along / 5)], -1)
    aperture = Aperture(sway, sway + [3.0, 0.5, 1.0])
    beam = swaying_beam(sway, (20, 0, 0), 60, sway_deg=0.0) if antenna else None
    abeam = Sector.of(aperture, chord_m=3.0, centre=0.05, half=0.3)
    counts = np.zeros(3, int)
    for centre in generator.uniform([-70, 15, -2], [70, 60, 4], (8, 3)):
        pixels = centre + generator.uniform(1, 3) * pixel_grid(12, 12, spacing_m=0.27, turned_deg=20.0, range_m=0.0)
        pixels[..., 2] += relief_m * np.sin(pixels[..., 0]) * np.cos(1.3 * pixels[..., 1])
        (surface,) = surfaces_of(pixels, [(slice(0, 12), slice(0, 12))])
        ahead = replace(abeam, centre=0.9).following(aperture, pixels[::11, ::11].reshape(-1, 3))
        for sector in (abeam, ahead):
            tile = weighed(Beams(beam, None, sector), aperture, surface, -74)
            weight = (
                Beams(beam, None, sector).weight(aperture, pixels.reshape(-1, 3)).reshape(len(tile.variant), 64, -1)
            )
            sector_weight = sector.weight(aperture, pixels.reshape(-1, 3)).reshape(weight.shape)
            silent = tile.variant == 2
            assert not weight[silent].any()
            assert (sector_weight[~silent & ~tile.edge] == 1).all()
            assert tile.edge[((sector_weight > 0) & (sector_weight < 1)).any(axis=(1, 2)) & ~silent].all()
            counts += [silent.sum(), (~silent & ~tile.edge).sum(), tile.edge.sum()]
    assert (counts > 20).all()


@pytest.mark.parametrize(("half", "nodes_db"), [(0.04, -74), (0.01, -50)])
def test_edges_too_steep_for_the_nodes_use_the_direct_kernel(plain, half, nodes_db):
    """By eq. 13, such edges require more than 128 nodes along a tile; pulses beyond the edges are still skipped."""
    beams = sector_of(plain, half)
    image, share = formed(plain, beams=beams, nodes_db=nodes_db)
    assert share[0] == 0
    assert (share[1:] > 0.3).all()
    assert weighted_error_db(plain, image, beams) <= setting(plain, nodes_db=nodes_db).error_db


def test_edges_with_a_kinked_sector_centre_use_the_direct_kernel(plain):
    """The centre has a kink where the flight starts to cover the whole sector; nodes cannot represent this kink."""
    beams = sector_of(plain, 0.25, 0.6)
    image, share = formed(plain, beams=beams)
    assert (share[:2] > 0.2).all()
    assert weighted_error_db(plain, image, beams) <= -64


@pytest.mark.parametrize("nodes_db", [-50, -74, -98])
@pytest.mark.parametrize("slope", [0.3, 0.8])
def test_sector_edge_widens_the_band_as_predicted(slope, nodes_db):
    """Eq. 13: the second derivative of the edge jumps; nodes for the widened band meet their design error."""
    at, generator, band_rad = np.linspace(-1, 1, 1001), np.random.default_rng(5), 15.0
    waves, kinks, tops = (generator.uniform(low, high, 150) for low, high in ((-15.0, 15.0), (-1, 1), (0, 1)))

    def interpolation_error_db(band):
        count = int(nodes_for(np.array([band]), nodes_db)[0])
        node_points = nodes(count, nodes_db)
        interpolation = weights(count, at, nodes_db, float(supports(nodes_db)[count]))

        def content(x):
            x = x[:, None]
            return edge((x - kinks) * slope + np.round(tops)) * np.exp(1j * waves * x)

        return float(10 * np.log10(np.mean(np.abs(interpolation @ content(node_points) - content(at)) ** 2)))

    wider_rad = float(widened_rad(slope, np.array([band_rad]), nodes_db)[0])
    assert nodes_db - 8 < interpolation_error_db(band_rad + wider_rad) <= nodes_db + 1
    assert interpolation_error_db(band_rad) > nodes_db + 4 or wider_rad < 4


def test_pulses_unsuited_to_a_tile_are_passed_to_its_quarters(monkeypatch):
    """A sector edge is twice as steep over a large tile as over each of its quarters."""
    flight = flown(pixel_grid(140, 150), pulses=300)
    beams = sector_of(flight, 0.1)
    image, share = formed(flight, beams=beams, side_px=256)
    monkeypatch.setattr(tree, "LEAST_QUARTER_PX", 256)
    whole, whole_share = formed(flight, beams=beams, side_px=256)
    assert share[1] == 0
    assert whole_share[1] == 1
    assert max(weighted_error_db(flight, formed_image, beams) for formed_image in (image, whole)) <= -64


def test_weighted_tiles_and_threads_give_bit_identical_images(isa, plain):
    """With an antenna pattern and a sector, tiles are bit-identical to the whole image in any thread."""
    sector = Sector.of(plain.aperture, chord_m=1.2, centre=0.02, half=0.15)
    beams = Beams(swaying_beam(plain.scene.tx, (12, 1, 0), 30, sway_deg=0.0), None, sector)
    chosen, points = setting(plain, nodes_db=-74), ecef(plain.pixels)
    trees = tree.prepare(plain.profiles, **chosen.options)
    whole = tree.form(trees, points, beams=beams, **chosen.form_options)
    assert weighted_error_db(plain, whole, beams) <= -64
    windows = pieces("tree", whole.shape, chosen.form_options)
    with ThreadPoolExecutor(2) as pool:
        alone = pool.map(lambda part: tree.form(trees, points[part], beams=beams, **chosen.form_options), windows)
        for window, image in zip(windows, alone, strict=True):
            np.testing.assert_array_equal(image.view(np.uint32), whole[window].view(np.uint32))


@pytest.mark.parametrize("pulses", [65, 68, 129, 130, 193])
def test_last_pulses_of_a_flight_are_weighted_like_all_others(plain, pulses):
    """This also holds if the beam ends among the last four pulses, fewer than the interval between sampled pulses."""
    flight, tilt = flown(pixel_grid(70, 90), pulses=pulses), np.radians(30)
    axes = swaying_beam(flight.scene.tx, (12, 0, 0), sway_deg=0).axes
    axes[-4:] = [[np.cos(tilt), np.sin(tilt), 0], [-np.sin(tilt), np.cos(tilt), 0], [0, 0, 1]] @ axes[-4:]
    angle = np.radians([-32.0, 0, 32.0])
    beams = Beams(Beam(axes, angle, np.ones(3), angle, np.ones(3)))
    image, _ = formed(flight, beams=beams)
    assert weighted_error_db(flight, image, beams) <= -60


@pytest.mark.parametrize("first", [1, 17, 65])
def test_profile_with_a_different_start_is_detected_at_any_pulse(first):
    flight = flown(pixel_grid(70, 90), pulses=128)
    start_m, samples = flight.profiles.start_m.copy(), flight.profiles.samples.copy()
    start_m[first] += 35 * flight.profiles.step_m  # inside the scene
    flight.profiles = replace(flight.profiles, start_m=start_m, samples=samples)
    image, share = formed(flight)
    assert share[1] > 0.2
    cells = tree.prepare(flight.profiles).direct_setting(-74).oversampling
    direct = native.form(native.prepare(flight.profiles, oversampling=cells), ecef(flight.pixels))
    assert decibels(image - direct, direct) <= -62


@pytest.mark.parametrize(
    "options", [{"side_px": 300}, {"side_px": 0}, {"chunk": 100}, {"nodes_db": -44}, {"height_layers": 99}]
)
def test_options_beyond_the_limits_of_the_library_are_refused(plain, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        tree.form(tree.prepare(plain.profiles), ecef(plain.pixels), **options)


@pytest.mark.parametrize("pulses", [slice(10, 300), slice(32, 64), slice(None, None, 2)])
def test_pulses_from_the_middle_of_a_leaf_are_refused(plain, pulses):
    with pytest.raises(ValueError, match="multiple of 64"):
        tree.prepare(plain.profiles)[pulses]


def test_beam_edges_use_the_direct_kernel(plain):
    soft, angle = swaying_beam(plain.scene.tx, (12, 0, 0), sway_deg=1), np.radians([-5.0, 0, 5.0])
    beams = Beams(Beam(soft.axes, angle, np.ones(3), angle, np.ones(3)))
    image, share = formed(plain, beams=beams)
    assert share.tolist() == [0, 1, 0]
    assert weighted_error_db(plain, image, beams) <= -62


@pytest.mark.parametrize("edges", [(0, 64, 192, 300), (0, 256, 300)])
def test_images_of_prepared_pulses_sum_to_the_whole(plain, edges):
    chosen, points = setting(plain, nodes_db=-74), ecef(plain.pixels)
    trees = tree.prepare(plain.profiles, **chosen.options)
    parts = [trees[first:last] for first, last in pairwise(edges)]
    assert [len(part) for part in parts] == np.diff(edges).tolist()
    total = sum(tree.form(part, points, **chosen.form_options) for part in parts)
    whole = tree.form(trees, points, **chosen.form_options)
    assert decibels(total - whole, whole) <= -65


@pytest.mark.parametrize(("count", "nodes_db"), [(8, -50), (20, -74), (40, -98)])
def test_table_of_supports_lists_the_widest_band_of_the_nodes(count, nodes_db):
    """tree_supports.csv: the band at which eq. 6 has the error `nodes_db`, for each number of nodes."""
    gauss, share = np.polynomial.legendre.leggauss(160)
    at = nodes(count, nodes_db)

    def interpolation_error_db(band_rad):
        white = [np.sinc(band_rad / np.pi * (a[:, None] - at)) for a in (gauss, at)]
        weight = weights(count, gauss, nodes_db, band_rad)
        covariance = white[1] + 10 ** ((nodes_db - 20) / 10) * np.eye(count)
        error = 1 - 2 * (weight * white[0]).sum(1) + ((weight @ covariance) * weight).sum(1)
        return 10 * np.log10(max(error @ share / 2, 1e-30))

    low, high = 0.0, np.pi / 2 * count
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (middle, high) if interpolation_error_db(middle) <= nodes_db else (low, middle)
    assert supports(nodes_db)[count] == pytest.approx(low, abs=0.02)


def test_phase_slope_peaking_in_a_tile_needs_nodes_for_its_airy_tail():
    """Eq. 4b: if the phase slope has a peak inside the tile, the spectrum extends beyond this slope."""
    at, error_db = np.linspace(-1, 1, 4001), -74
    highest_rad, bend_rad = 60.0, 40.0

    def interpolation_error_db(band_rad):
        count = int(nodes_for(np.array([band_rad]), error_db)[0])
        wave = np.exp(1j * (highest_rad * at - bend_rad * at**3 / 6))
        wave_at_nodes = np.exp(1j * (highest_rad * nodes(count, error_db) - bend_rad * nodes(count, error_db) ** 3 / 6))
        interpolated = weights(count, at, error_db, float(supports(error_db)[count])) @ wave_at_nodes
        return decibels(interpolated - wave, wave)

    assert interpolation_error_db(highest_rad + 3 * np.cbrt(bend_rad / 2)) < -70
    assert interpolation_error_db(highest_rad) > -30


def test_tile_band_is_the_largest_phase_slope_plus_an_airy_tail():
    """Eq. 4 and 4b for a tile below the track, with a slope peak inside, agree with finite differences of paths."""
    along = np.linspace(-2, 2, 128)
    track = np.stack([along, np.full(128, -1.0), np.full(128, 3.0)], -1)
    pixels = pixel_grid(64, 64, spacing_m=0.08, range_m=0.0)
    (surface,) = surfaces_of(pixels, [(slice(0, 64), slice(0, 64))])
    aperture = Aperture(track, track)
    (band, *_) = view_of_tile(aperture, surface, (64,), **WAVENUMBERS).bands_rad
    k, b = WAVENUMBERS.values()
    at, step = np.linspace(-1, 1, 201), 1e-4

    def paths(xi, eta, pulses):
        point = (
            surface.centre_m + xi[..., None] * surface.coefficients[0, 1] + eta[..., None] * surface.coefficients[1, 0]
        )
        return aperture[pulses].path(point)

    def slopes(xi, eta, pulses):
        return (paths(xi + step, eta, pulses) - paths(xi - step, eta, pulses)) / (2 * step)

    xi, eta = np.meshgrid(at, at)
    widest, leaf = np.zeros_like(xi), np.array([0, 31, 63])
    for first in (0, 64):
        shared = slopes(xi, eta, [64]) - slopes(xi, 0 * eta, [64])
        reference = slopes(xi, 0 * eta, [first + 31]) + shared
        slope = slopes(xi, eta, first + leaf)
        widest = np.maximum(widest, (k * np.abs(slope - reference) + b * np.abs(slope)).max(axis=0))
    bend = -np.diff(widest, 2, axis=1).min() / (at[1] - at[0]) ** 2
    assert widest.max() < band[0] < widest.max() + 3.3 * np.cbrt(max(bend, 0) / 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"oversampling": 1.2}, "must be at least 1.5"),
        (
            {
                "samples": np.zeros((0, 5), np.complex64),
                "start_m": np.zeros(0),
                "aperture": Aperture(*np.zeros((2, 0, 3))),
            },
            "must contain at least one pulse",
        ),
        ({"start_m": np.full(300, np.nan)}, "must be finite"),
    ],
)
def test_invalid_profiles_are_refused(plain, changes, message):
    with pytest.raises(ValueError, match=message):
        tree.prepare(replace(plain.profiles, **changes))


def test_pixels_and_beams_of_wrong_shape_are_refused(plain):
    trees = tree.prepare(plain.profiles)
    with pytest.raises(ValueError, match=r"must be \(y, x, 3\)"):
        tree.form(trees, np.zeros((4, 3)))
    with pytest.raises(ValueError, match="beams must have 300 pulses"):
        tree.form(trees, ecef(plain.pixels), beams=Beams(swaying_beam(plain.scene.tx[:9], (12, 0, 0))))
