"""Flags of scenes, plans, refined tracks, images and sums."""

from apertura.common.flags.flag import Flag

OF_IMAGES = {
    "platform_inside_scene": Flag(
        "pulses above the scene, of all", "pulses above the scene: echoes of both sides mix", "scene.bounds_m",
        "core/planning/plan.py"),
    "platform_below_scene": Flag(
        "m below the lowest ground of the scene", "an antenna is lower than all of a DEM beside it",
        "unit and datum of scene.dem", "core/scene/clearance.py"),
    "outside_swath": Flag(
        "share of the scene, and the integration angle",
        "a part of the scene is passed by no pulse inside the integration angle: it is zero",
        "scene.bounds_m; processing.integration", "core/planning/decisions.py"),
    "integration_turns": Flag(
        "the angle that places are seen under, and the integration angle",
        "the track turns, or passes places more than once: they are seen under more than the integration angle, "
        "and are sharper along some direction",
        "config/segments.tsv, to image passes apart", "core/planning/decisions.py"),
    "spacing_coarse": Flag(
        "spacing of pixels, and the finest resolution cell", "pixels are wider than the finest resolution cell",
        "scene.spacing_m", "core/planning/plan.py"),
    "pulses_sparse": Flag(
        "spread of phase rates over the scene, cycles per pulse; 1 is unambiguous",
        "the aperture is undersampled: azimuth ambiguities", "scene.bounds_m; speed and waveform.prf_hz",
        "core/planning/plan.py"),
    "pulses_missing": Flag(
        "missing pulses, of all in the aperture, and dB of the sidelobes they raise",
        "pulses missing inside the aperture, dropped or never recorded, raise sidelobes above −20 dB along the track",
        "pulses of the echo: what was dropped and why", "core/echo/association.py"),
    "beyond_cyclic_prefix": Flag(
        "share of the scene that arrives too late",
        "part of the scene lies beyond the prefix, or the listening time, of every pulse", "scene.bounds_m",
        "core/planning/plan.py"),
    "scene_beyond_samples": Flag(
        "share of the scene's total paths",
        "from Python: part of the scene's total paths lies beyond the profiles given", "how the profiles were cropped",
        "core/imaging/job.py"),
    "beam_misses": Flag(
        "share of the scene", "part of the scene is seen by no antenna beam", "boresights; scene.bounds_m",
        "core/antenna/illumination.py"),
    "prediction_misses": Flag(
        "error predicted and accuracy asked, dB", "the plan is expected to miss the accuracy asked",
        "engine and options asked for", "core/planning/planner.py"),
    "refinement_rejected": Flag(
        "dB of contrast gained on places that were not fitted, and the share of them that got sharper",
        "tracks, or phases of pulses, refined by the images are not believed: places that were not fitted did "
        "not get sharper; images are formed from the logs",
        "position_std_m of the nodes; SNR; docs/howto/refine_tracks.md", "methods/autofocus/evidence.py"),
    "refinement_too_few_patches": Flag(
        "bright places found, and those needed",
        "too few bright places to refine tracks by; images are formed from the logs",
        "reflectors in the scene; processing.autofocus off", "methods/autofocus/patches.py"),
    "prior_inconsistent": Flag(
        "how large the motions are against the errors stated",
        "motions that the images settle are much larger or smaller than the errors that logs or config state",
        "position_std_m, position_correlation_s; lever arms, heights, times", "methods/autofocus/evidence.py"),
    "cycle_slip_suspected": Flag(
        "parts of the track, and how far off",
        "parts of the refined track may be a wavelength off: they see points at another range than the whole",
        "position_std_m; more bright points", "methods/autofocus/evidence.py"),
    "defocused": Flag(
        "dB lost at bright points, and dB that the budget expects",
        "bright points lost more than 1 dB of their peak to phase errors",
        "the hypothesis named behind it; positions, lever arms, heights, times", "core/imaging/focus_check.py"),
    "echo_elsewhere": Flag(
        "where the pulses hold the strong echo",
        "nothing bright in the image, and pulses hold a strong echo: at ranges that the scene does not have, or "
        "that no place gathers",
        "heights and datum of log and scene; scene.bounds_m; path offsets", "core/imaging/focus_check.py"),
    "pairs_apart": Flag(
        "cm between the places of the points, with its uncertainty, east and north",
        "two pairs of a flight show the same points at different places",
        "the hypothesis named behind it; path offsets, lever arms, scene.height_m", "pipeline/steps/assess.py"),
    "pairs_out_of_phase": Flag(
        "phase between the pairs, with its uncertainty",
        "two pairs show the same points in different phase: one is left out of the coherent sum",
        "path offsets; processing.fusion.align_phase", "pipeline/steps/assess.py"),
    "pair_left_out": Flag(
        "the pair, and why", "the coherent sum is without a pair that shows other places, or another phase",
        "the flags of that pair; processing.fusion.align_phase", "pipeline/steps/export.py"),
    "flights_apart": Flag(
        "cm between the places of the points, with its uncertainty, east and north",
        "two flights show the same points at different places", "base station, datum, time system of one flight",
        "pipeline/steps/cube.py"),
    "pair_unconfirmed": Flag(
        "bright points in common", "a pair shows none of the bright points of another",
        "SNR of its echo; names of its channels", "pipeline/steps/assess.py"),
    "accuracy_missed": Flag(
        "bound of the error, and the accuracy asked, dB",
        "the error is not known to be below the accuracy asked, 95 % sure",
        "processing.accuracy_db, processing.engine", "core/imaging/certify.py, core/imaging/backproject.py"),
    "interferogram_decorrelated": Flag(
        "pixels more coherent than chance, of all that both images see; coherence, chance, and what geometry leaves",
        "most pixels of two images have nothing in common: no phase, no height",
        "distance of the tracks; what changed between the flights; focus of both images",
        "methods/interferometry/comparison.py"),
    "height_insensitive": Flag(
        "pixels where one turn of the phase is more height than the range, of all that both images see",
        "tracks lie too close together for a height: there is none", "tracks further apart",
        "methods/interferometry/comparison.py"),
    "height_ambiguous": Flag(
        "pixels in parts apart, or jumps of the phase where nobody unwraps; height of one turn",
        "heights are known up to multiples of the height of one turn, or left out where parts do not hang together",
        "extra unwrap; tracks closer together; a wider interferometry.window_px",
        "methods/interferometry/comparison.py"),
    "unwrapping_inconsistent": Flag(
        "loops of four pixels around which the phase contradicts itself, of all; places that several pixels show",
        "the phase changes by more than half a turn per pixel, or is noise: heights may err by whole turns",
        "tracks closer together; a DEM; interferometry.window_px", "methods/interferometry/comparison.py"),
    "height_relative": Flag(
        "that no point of known height shows",
        "a constant of the phase is not observable: heights count from the terrain, and an error of it changes over "
        "the scene", "scene.reference_points", "methods/interferometry/comparison.py"),
}  # fmt: skip
"""Name → what it says; see `apertura.common.flags.FLAGS`."""
