"""Flags of an image: quantity measured, meaning, advice, module. docs/flags.md is generated from this table.

Rows are in processing order, from recording to image. `Flags` reads the names alone.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Flag:
    """Limit of a method that an image may exceed.

    Parameters
    ----------
    measured
        Quantity that the flag's line reports, with its unit.
    meaning
        Consequence for the image.
    advice
        What to check first, or the remedy.
    raised
        Module that raises it, relative to src/apertura; several are separated by commas.

    Examples
    --------
    >>> Flag("share of samples", "samples at full scale", "gain", "core/echo/captures.py").advice
    'gain'
    """

    measured: str
    meaning: str
    advice: str
    raised: str


# ---- Recordings, flight logs, clocks and sidelinks

_OF_RECORDINGS = {
    "association_ambiguous": Flag(
        "time offset of the nodes' tags, s and pulse intervals",
        "the time offset is close to half a pulse interval: pulses may be paired with a neighbour",
        "frame counters; clocks of the nodes",
        "core/echo/association.py",
    ),
    "association_sparse": Flag(
        "share of the pulses of the shorter recording that were paired",
        "less than half of the pulses of the shorter recording were paired",
        "flights and nodes in flights.tsv; missed triggers",
        "core/echo/association.py",
    ),
    "frame_counter_conflict": Flag(
        "pulses dropped",
        "frame counters and time tags disagree",
        "number of bits of the frame counter",
        "core/echo/association.py",
    ),
    "time_tag_offset": Flag(
        "time offset of the nodes' tags, s, and distance flown in it, m",
        "time tags of the nodes differ by more than 20 ms: positions belong to another moment",
        "time system of each node",
        "core/echo/association.py",
    ),
    "time_tag_outlier": Flag(
        "pulses dropped, deviation of their tags",
        "single time tags deviate from the line fitted to all tags",
        "triggers of both nodes",
        "core/echo/association.py",
    ),
    "pulses_unpaired": Flag(
        "unpaired pulses before and after the other recording",
        "more than 5 % of the transmitted pulses lie outside the other recording",
        "start and end of the recordings; time tags late by a number of pulse intervals",
        "core/echo/association.py",
    ),
    "fix_quality_low": Flag(
        "pulses dropped, per node",
        "the fix type of the log is below the configured minimum",
        "the flight log; nodes.<n>.worst_fix",
        "stages/positions.py",
    ),
    "alignment_ambiguous": Flag(
        "the other clock offset, and its contrast relative to the best, dB",
        "another clock offset, or every one, focuses nearly as well",
        "alignment on a reflector (apertura align --point); a track with changes of speed",
        "methods/alignment/on_point.py",
    ),
    "alignment_at_edge": Flag(
        "clock offset, range searched",
        "the best clock offset lies at an end of the range searched",
        "--search-s",
        "methods/alignment/on_point.py",
    ),
    "alignment_uncertain": Flag(
        "contrast of the best clock offset above the others, dB",
        "the best clock offset is hardly better than the others",
        "position of the point; path offset; whether the flight log belongs to the recording",
        "methods/alignment/on_point.py",
    ),
    "scans_incomplete": Flag(
        "scans excluded",
        "messages of scans are missing, damaged or truncated",
        "the recorder; the copy of the file",
        "formats/phase_histories/pulson.py",
    ),
    "sweep_motion": Flag(
        "path change per sweep, wavelengths; displacement of echoes, m",
        "the antennas move within a sweep: envelope and phase of echoes disagree",
        "waveform.sweep_s; a slower flight, or stops while sweeping",
        "core/echo/dechirp.py",
    ),
    "track_epochs_dropped": Flag(
        "epochs excluded, by reason",
        "epochs without a fix, damaged or duplicated",
        "the flight log, if track_gap is raised too; otherwise nothing",
        "stages/positions.py",
    ),
    "track_log_damaged": Flag(
        "bytes or lines of the log that are not valid messages",
        "the flight log is damaged: epochs are missing or may be wrong",
        "the storage medium; the copy of the log",
        "stages/positions.py",
    ),
    "track_gap": Flag(
        "pulses dropped, longest gap",
        "a gap of the flight log is too long for interpolation by the spline",
        "rate and losses of the flight log",
        "stages/positions.py",
    ),
    "track_outlier": Flag(
        "pulses dropped, number of outliers, largest deviation",
        "epochs of the flight log are outliers, or the track has a step",
        "multipath, cycle slips, export of the log",
        "stages/positions.py",
    ),
    "hover": Flag(
        "pulses dropped, duration",
        "platform stationary: these pulses would add weight to a single aspect",
        "config/segments.tsv, which takes precedence for the pairs that it lists",
        "stages/positions.py",
    ),
    "track_frozen": Flag(
        "pulses dropped, epochs, largest deviation",
        "epochs repeat the previous position",
        "output rate of the receiver compared with that of the log",
        "stages/positions.py",
    ),
    "track_positions": Flag(
        "position error, m",
        "coordinates of the flight log are rounded too coarsely",
        "decimals of the log's coordinates: 8 in degrees, 6 in minutes (NMEA)",
        "stages/positions.py",
    ),
    "track_times": Flag(
        "position error along the track, m",
        "times of the flight log are rounded too coarsely",
        "decimals of the log's times",
        "stages/positions.py",
    ),
    "attitude_suspect": Flag(
        "angle between yaw and course, degrees, as logged and in another convention",
        "the attitude appears to be in radians or anticlockwise: lever arms and beams are rotated wrongly",
        "export of the log; nodes.<n>.attitude: course or none",
        "stages/positions.py",
    ),
    "time_tag_jitter": Flag(
        "scatter of the time tags, s rms; pulse repetition interval",
        "single pulses may be paired with a neighbour",
        "frame counters",
        "core/echo/association.py",
    ),
    "association_suspect": Flag(
        "difference between the sidelink path and the geometry, m",
        "the sidelink contradicts the geometry: pulses are paired wrongly, or positions are wrong",
        "time tags, flight logs, lever arms",
        "core/echo/transfer.py",
    ),
    "reference_point": Flag(
        "largest difference between reception and reference point, s and m of path",
        "CPHD: positions and times of the pulses contradict each other",
        "the software that wrote the file; whether the image is focused",
        "formats/phase_histories/cphd.py",
    ),
    "captures_repeated": Flag(
        "captures excluded, of how many; number of the first",
        "captures are bit-identical to earlier ones: the recorder wrote old samples again, which would image as ghosts",
        "buffers of the recorder; the copy of the recording",
        "stages/echo.py",
    ),
    "captures_limited": Flag(
        "captures affected, of how many; their crest factor and that of the others, dB",
        "some captures are limited below full scale: their echoes are weaker and distorted",
        "limiter, gain control and gain of the receiver",
        "core/echo/captures.py",
    ),
    "saturated_radar": Flag(
        "share of the samples",
        "samples at full scale of the converter",
        "gain",
        "core/echo/captures.py",
    ),
    "saturated_sidelink": Flag(
        "share of the samples",
        "samples at full scale of the converter",
        "gain",
        "core/echo/captures.py",
    ),
    "code_unconfirmed": Flag(
        "strongest echo above the level beyond the prefix, dB",
        "echoes repeat from pulse to pulse but do not lie within the prefix or listening time",
        "waveform.codes, waveform.pulse; another transmitter",
        "core/echo/own_pulses.py",
    ),
    "phase_unstable": Flag(
        "second differences of phase, rad rms; stability of the magnitude",
        "echoes have a stable magnitude but no stable phase: the image is speckle",
        "oscillator of the node; which node transmits",
        "core/echo/own_pulses.py",
    ),
    "wrong_code": Flag(
        "SNR of the sidelink",
        "the sidelink contains another code: that of the transmitter if all of its pairs have this flag, "
        "otherwise that of another transmitter",
        "waveform.codes, waveform.carrier_is, waveform.iq, nodes.<n>.iq; the recording",
        "core/echo/sidelink_state.py",
    ),
    "background": Flag(
        "image noise with arcs of the background, dB above that without; why it is not removed",
        "echoes at constant delay, such as antenna coupling, cause arcs at constant range",
        "processing.background; isolation of the antennas",
        "core/imaging/background.py",
    ),
    "background_loss": Flag(
        "largest peak loss of a target, dB",
        "the removed background contains part of targets whose range hardly changes",
        "processing.background: none; a longer track",
        "core/imaging/background.py",
    ),
    "sidelink_lost": Flag(
        "pulses dropped",
        "pulses without a sidelink were dropped",
        "blockage; antenna of the sidelink",
        "core/echo/sidelink_state.py",
    ),
    "second_arrival": Flag(
        "second path relative to the direct one, dB; its delay",
        "a second path is nearly as strong as the direct one",
        "a second transmitter; reflections",
        "core/echo/sidelink_state.py",
    ),
    "sidelink_nulls": Flag(
        "share of subcarriers far below the mean",
        "parts of the band are attenuated instead of corrected",
        "reflections at the sidelink antenna",
        "core/echo/sidelink_state.py",
    ),
    "sidelink_noisy": Flag(
        "SNR of the sidelink, SNR required",
        "the SNR is below the minimum of the correction",
        "processing.sidelink: auto selects another correction",
        "core/echo/sidelink.py",
    ),
    "sidelink_echo": Flag(
        "echo relative to the direct path, dB",
        "an echo in the sidelink causes ghosts",
        "processing.sidelink",
        "core/echo/sidelink.py",
    ),
    "sidelink_ripple": Flag(
        "residual ripple over the band, dB",
        "ripple of the transmitter remains after the correction",
        "processing.sidelink",
        "core/echo/sidelink.py",
    ),
    "sidelink_ripple_or_echo": Flag(
        "arrival relative to the direct path, dB and m",
        "the arrival may be an echo: path and phase may have this error",
        "reflections at the sidelink antenna",
        "core/echo/sidelink_state.py",
    ),
    "sidelink_code": Flag(
        "correction requested",
        "the sidelink lacks the code that the correction requires",
        "waveform.codes",
        "core/echo/sidelink.py",
    ),
    "waveform_sidelobes": Flag(
        "range sidelobes of every point, dB",
        "the pulse's filter leaves an uneven spectrum: range sidelobes",
        "waveform.filter, waveform.band_hz",
        "core/echo/pulse_filter.py",
    ),
    "waveform_noise": Flag(
        "SNR loss, dB; share of the band with little energy",
        "division by the pulse's spectrum amplifies noise where the pulse has little energy",
        "waveform.band_hz; waveform.filter",
        "core/echo/pulse_filter.py",
    ),
    "pulse_truncated": Flag(
        "pulses whose direct path is truncated by the capture",
        "captures truncate the direct pulse: division leaves sidelobes and loses energy",
        "waveform.lead_s; trigger of the receiver",
        "core/echo/pulse_filter.py",
    ),
    "clock_ambiguous": Flag(
        "carrier frequency offset, half the subcarrier spacing, Hz",
        "the carrier frequency offset is close to half the subcarrier spacing",
        "oscillator of the receiver",
        "core/echo/clock.py",
    ),
    "clock_uncertain": Flag(
        "standard deviation of the carrier frequency offset, Hz",
        "the clock offset is too uncertain for the requested accuracy",
        "SNR of the sidelink",
        "core/echo/clock.py",
    ),
    "clock_unmeasured": Flag(
        "reason",
        "captures are too short, or the pulse neither repeats nor is divided out",
        "length of the captures; processing.sidelink",
        "core/echo/transfer.py",
    ),
    "calibration_uncertain": Flag(
        "path offset, its scatter, scatter allowed",
        "the path offset scatters more than an image allows",
        "the reflector; the track",
        "core/echo/calibration.py",
    ),
    "calibration_ambiguous": Flag(
        "second reflector relative to the first, dB; its path offset",
        "a second reflector is nearly as strong",
        "calibration.search_m",
        "core/echo/calibration.py",
    ),
}
"""Flags raised before image formation: name → row."""


# ---- Scene, plan, track refinement, image and sums of pairs

_OF_IMAGES = {
    "platform_inside_scene": Flag(
        "pulses above the scene",
        "the track crosses the scene: echoes of both sides overlap",
        "scene.bounds_m",
        "core/planning/plan.py",
    ),
    "platform_below_scene": Flag(
        "height of the antenna below the lowest terrain of the scene, m",
        "an antenna is below the whole DEM near it",
        "unit and vertical datum of scene.dem",
        "core/scene/clearance.py",
    ),
    "terrain_step": Flag(
        "height of the step and its width on the ground, m; its position",
        "the DEM has a step steeper than 79 degrees",
        "voids filled with a constant, seams of the DEM; nothing, if it is a cliff",
        "stages/scene.py",
    ),
    "outside_swath": Flag(
        "share of the scene, integration angle",
        "part of the scene is not seen by any pulse within the integration angle: no data there",
        "scene.bounds_m; processing.integration",
        "core/planning/decisions.py",
    ),
    "track_turns": Flag(
        "range of aspect angles, integration angle",
        "the track turns or returns: resolution is finer in some directions",
        "config/segments.tsv, to image the passes separately",
        "core/planning/decisions.py",
    ),
    "no_aperture": Flag(
        "length of the antennas' track, m",
        "the aperture is too short, as seen from the scene, to form an image",
        "kind bench in flights.tsv; the flight log; config/segments.tsv",
        "core/planning/plan.py",
    ),
    "spacing_coarse": Flag(
        "pixel spacing, finest resolution cell",
        "the pixel spacing exceeds the finest resolution cell by more than 5 %",
        "scene.spacing_m",
        "core/planning/plan.py",
    ),
    "azimuth_undersampled": Flag(
        "Doppler spread, cycles per pulse; aliased fraction of the scene and its level, dB",
        "the aperture is undersampled: azimuth ambiguities are visible",
        "scene.bounds_m; flight speed and waveform.prf_hz",
        "core/planning/plan.py",
    ),
    "pulses_missing": Flag(
        "missing pulses, level of their sidelobes, dB",
        "sidelobes along the track, caused by missing pulses, exceed −20 dB",
        "pulses section of image.json: pulses dropped, with reasons",
        "core/echo/association.py",
    ),
    "scene_beyond_recording": Flag(
        "shares of the scene not recorded by all pulses and by none; pulses; longest and recorded total path",
        "echoes of part of the scene arrive after the recorded delays: its pixels have fewer pulses, or none",
        "scene.bounds_m; scene.height_m if it is the default; looks.tif and nesz.tif of these pixels",
        "stages/planning.py",
    ),
    "scene_beyond_samples": Flag(
        "share of the total paths of the scene",
        "from Python: range profiles do not cover the scene",
        "the range window to which the profiles were cropped",
        "core/imaging/job.py",
    ),
    "outside_beam": Flag(
        "share of the scene",
        "part of the scene lies outside every antenna beam",
        "boresights; scene.bounds_m",
        "core/antenna/illumination.py",
    ),
    "antenna_phase": Flag(
        "peak loss of a point, dB; its displacement, cm",
        "the phase of antenna patterns changes over the aperture",
        "lever_arms_m, which must end at the phase centre; phase_deg of the pattern",
        "core/quality/budget.py",
    ),
    "refinement_rejected": Flag(
        "gain of contrast on held-out points, dB; gain required",
        "contrast on held-out points did not improve significantly, or a track is displaced by a wavelength: the "
        "unrefined tracks are used",
        "position_std_m of the nodes; SNR; docs/howto/refine_tracks.md",
        "methods/autofocus/evidence.py",
    ),
    "refinement_no_bright_point": Flag(
        "contrast required of a bright point",
        "no bright point for track refinement: the unrefined tracks are used",
        "reflectors in the scene; processing.autofocus: off",
        "methods/autofocus/patches.py",
    ),
    "cause_corrected": Flag(
        "cause, its size, loss explained, dB",
        "a wrong constant explains the loss better than track errors: the images are formed with it corrected",
        "the constant named: lever_arms_m or attitude, config/clocks.tsv, scene.height_m",
        "methods/autofocus/cause_fit.py",
    ),
    "path_offsets_differ": Flag(
        "difference of path, cm, and its standard deviation",
        "after refinement, bright points of the pairs differ by a constant path",
        "nodes.<n>.path_offset_m of the pair's receiver; lever arms",
        "methods/autofocus/refine.py",
    ),
    "position_error_understated": Flag(
        "estimated track errors relative to the configured ones",
        "estimated track errors are much larger than configured",
        "position_std_m, position_correlation_s; lever arms, heights, times",
        "methods/autofocus/evidence.py",
    ),
    "position_error_overstated": Flag(
        "estimated track errors relative to the configured ones",
        "estimated track errors are much smaller than configured: the refinement has more freedom than needed",
        "position_std_m, position_correlation_s",
        "methods/autofocus/evidence.py",
    ),
    "cycle_slip_suspected": Flag(
        "sections of the track, their displacement",
        "sections of the refined track may be displaced by a wavelength",
        "position_std_m; more bright points",
        "methods/autofocus/evidence.py",
    ),
    "defocused": Flag(
        "peak loss of bright points, dB; peak loss expected by the error budget, dB",
        "phase errors reduced the peaks of bright points by more than 1 dB",
        "the hypothesis, where one is named; positions, lever arms, heights, times",
        "core/imaging/focus_check.py",
    ),
    "loss_unexpected": Flag(
        "peak loss of bright points and expected loss, dB, with standard deviations",
        "the peak loss is 1 dB at most, but exceeds the error budget by three standard deviations, or is removed "
        "by the cause identified in another image",
        "nodes.<n>.position_std_m, scene.height_std_m, time_tag_std_s: are they realistic?",
        "core/imaging/focus_check.py",
    ),
    "echo_outside_scene": Flag(
        "position of the strong echo",
        "the pulses contain a strong echo at ranges outside the scene, or one that does not focus at any position",
        "heights and vertical datum of log and scene; scene.bounds_m; path offsets; I and Q swapped: waveform.iq; "
        "from Python: conjugate the samples",
        "core/imaging/focus_check.py",
    ),
    "pairs_displaced": Flag(
        "displacement of the points, cm, east and north",
        "bright points of a pair are displaced relative to the other pairs, or no majority of the pairs agrees on "
        "their position",
        "the hypothesis, where one is named; path offsets, lever arms, scene.height_m",
        "stages/assess.py",
    ),
    "pairs_out_of_phase": Flag(
        "phase relative to the pairs that agree",
        "bright points of a pair differ in phase from the other pairs, or no majority of the pairs agrees: "
        "excluded from the coherent sum",
        "path offsets; processing.fusion.align_phase",
        "stages/assess.py",
    ),
    "pair_excluded": Flag(
        "pair, reason, phase that would align it",
        "a pair is excluded from the coherent sum",
        "flags of that pair; processing.fusion.align_phase",
        "stages/export.py",
    ),
    "phase_unobservable": Flag(
        "pair, reason, peak loss caused by a wrong phase, dB",
        "the phase offset of a pair in the coherent sum is not observable: if it is wrong, targets split",
        "as stated in the flag: a finer scene.spacing_m, or a reflector in the scene, or a calibration flight",
        "stages/export.py",
    ),
    "sum_incoherent": Flag(
        "share of the power in phase at bright points; peak loss, dB",
        "pairs of the coherent sum are not in phase: its peaks are reduced",
        "pairs_out_of_phase, phase_unobservable; positions; processing.fusion.align_phase",
        "stages/export.py",
    ),
    "flights_displaced": Flag(
        "displacement of the points, cm, east and north",
        "bright points of two flights are displaced relative to each other",
        "base station, datum, time system of one flight",
        "stages/cube.py",
    ),
    "pair_unconfirmed": Flag(
        "bright points in common",
        "a pair has no more bright points in common with another pair than expected by chance",
        "SNR of its echo; names of its channels",
        "stages/assess.py",
    ),
    "pair_uncalibrated": Flag(
        "file of calibration constants, pair",
        "no calibration constant is known for the pair: backscattering coefficients have no values",
        "a reflector that serves the pair; transmit_power_dbm and receivers of its nodes",
        "stages/layers.py",
    ),
    "constant_drifts": Flag(
        "difference between flights or calibrations, dB or rad; its standard deviation",
        "the calibration constant or phase changed by more than three standard deviations",
        "cables, gains, temperature; pointing of the antennas",
        "tools/reflectors.py",
    ),
    "reflectors_disagree": Flag(
        "reflectors, sum of squared residuals, its probability",
        "reflectors disagree: the standard deviation of the calibration constant was increased",
        "positions, sizes and orientations of the reflectors; other echoes; antenna patterns",
        "tools/reflectors.py",
    ),
    "constant_disagrees": Flag(
        "difference between configured radio and measured constant, dB, in standard deviations",
        "the config contradicts the reflectors; their constant was used",
        "transmit_power_dbm, antenna gains, receiver",
        "stages/radiometry.py",
    ),
    "noise_disagrees": Flag(
        "measured noise relative to the configured noise figure, dB, or to that at the reflectors",
        "noise too high: interference, too little gain, a wrong gain or full scale; noise too low: a wrong gain "
        "or full scale, and all cross-sections have the same error",
        "nodes.<n>.receiver: gain_db, full_scale_dbm or full_scale_v, full_scale_counts, noise_figure_db",
        "stages/radiometry.py",
    ),
    "engine_replaced": Flag(
        "tiles, engine requested and engine used, accuracy",
        "the requested engine does not meet the requested accuracy: another engine formed the image, or some of "
        "its tiles",
        "processing.engine: auto, or a coarser processing.accuracy_db",
        "core/planning/plan.py",
    ),
    "accuracy_not_met": Flag(
        "upper bound of the error, requested accuracy, dB",
        "the 95 % upper bound of the numerical error exceeds the requested accuracy",
        "processing.accuracy_db, processing.engine",
        "core/imaging/certify.py, core/imaging/backproject.py",
    ),
    "interferogram_decorrelated": Flag(
        "share of pixels with significant coherence; coherence, coherence by chance, coherence allowed by the geometry",
        "the two images have little coherence: neither phase nor height is usable",
        "baseline of the tracks; changes between the flights; focus of both images",
        "methods/interferometry/comparison.py",
    ),
    "height_insensitive": Flag(
        "share of pixels where the height of ambiguity exceeds the height range",
        "the baseline is too short to measure heights",
        "a longer baseline",
        "methods/interferometry/comparison.py",
    ),
    "height_ambiguous": Flag(
        "pixels in unconnected regions, or phase jumps where the phase is not unwrapped; height of ambiguity",
        "heights are ambiguous by multiples of the height of ambiguity, or missing where regions do not connect",
        "the optional dependency unwrap; a shorter baseline; a wider interferometry.window_px",
        "methods/interferometry/comparison.py",
    ),
    "unwrapping_inconsistent": Flag(
        "loops of four pixels with a phase residue; pixels in layover",
        "the phase changes by more than half a cycle per pixel, or is noisy: heights may have errors of multiples "
        "of the height of ambiguity",
        "a shorter baseline; a DEM; interferometry.window_px",
        "methods/interferometry/comparison.py",
    ),
    "height_relative": Flag(
        "no point of known height lies in the image",
        "heights are relative to the terrain model; their offset varies over the scene",
        "scene.reference_points",
        "methods/interferometry/comparison.py",
    ),
}
"""Flags of images: name → row."""


# ---- Bench recordings (stationary radar)

_OF_BENCHES = {
    "triggers_missed": Flag(
        "pulses not recorded, of those expected",
        "more than 1 % of the pulses triggered no capture",
        "trigger level and cable; disk of the recorder",
        "methods/bench/channels.py",
    ),
    "triggers_false": Flag(
        "captures between two pulses",
        "the recorder was triggered by something other than the radar's pulses",
        "trigger level; interference; waveform.prf_hz",
        "methods/bench/channels.py",
    ),
    "channel_weak": Flag(
        "level of a channel, counts rms",
        "the signal covers few quantisation levels of the converter: quantisation adds noise",
        "gain, attenuators, cable of the channel",
        "methods/bench/channels.py",
    ),
    "channel_dc": Flag(
        "mean of I and Q relative to the signal, dB",
        "a DC offset of the samples corrupts one subcarrier and thereby all ranges",
        "offset of the converter, leakage of the local oscillator",
        "methods/bench/channels.py",
    ),
    "channel_image": Flag(
        "level of the image frequency, dB",
        "I/Q imbalance: subcarriers leak into their image frequencies",
        "balance of the mixer; clipping of I or Q",
        "methods/bench/channels.py",
    ),
    "channel_bits_stuck": Flag(
        "bits that never change",
        "a bit of the converter or of its bus is stuck",
        "data lines of the converter; sample format of the recorder",
        "methods/bench/channels.py",
    ),
    "spectrum_inverted": Flag(
        "node",
        "I and Q are swapped, or the local oscillator lies above the band",
        "order of I and Q in the recorder; side of the local oscillator: waveform.iq, or nodes.<n>.iq of one node",
        "core/echo/transfer.py",
    ),
    "link_weak": Flag(
        "level of a compressed pulse above the noise, dB",
        "the path is hardly above the noise",
        "attenuators, cables, gain; assignment of the channels",
        "methods/bench/links.py",
    ),
    "link_incoherent": Flag(
        "coherence factor Γ, its value with noise alone, phase noise in excess",
        "the phase of the path scatters more than noise explains: images have the same loss",
        "clock of both channels; sidelink; connectors",
        "methods/bench/links.py",
    ),
    "link_drifts": Flag(
        "phase and delay drift over the recording",
        "path or delay changes with a stationary set-up",
        "warm-up of cables, amplifiers and filters: wait, or calibrate again",
        "methods/bench/links.py",
    ),
    "delay_jumps": Flag(
        "pulses at another delay, its difference",
        "delays jump with a stationary set-up: captures start elsewhere, or the strongest path changes",
        "trigger of the transmitter; cables; two reflectors of equal strength",
        "methods/bench/links.py",
    ),
    "interference": Flag(
        "noise of a subcarrier relative to its neighbours, dB; its frequency and usual service",
        "a narrow-band signal in the band adds noise at every range; excluded subcarriers cause sidelobes",
        "other transmitters; spurious signals of the node's clocks; processing.interference",
        "methods/bench/links.py, core/echo/interference.py",
    ),
    "contact_intermittent": Flag(
        "change of amplitude in excess of noise; pulses lost or 6 dB low",
        "the amplitude is unstable with a stationary set-up",
        "connectors of that channel; supply of the amplifiers",
        "methods/bench/links.py",
    ),
    "channel_crosstalk": Flag(
        "sidelink relative to the strongest path, dB",
        "the sidelink leaks into the radar channel: a false echo at short range",
        "shielding, parallel cables, isolation of the channels",
        "methods/bench/links.py",
    ),
    "channels_swapped": Flag(
        "lead of the echo over the sidelink, m",
        "the strongest echo arrives before the direct path",
        "order of the channels; bench.radar_m, bench.sidelink_m",
        "methods/bench/links.py",
    ),
    "clock_unlocked": Flag(
        "frequency offset from the transmitter's clock, ppm",
        "the clocks have no common reference: samples are corrected by the measured offset",
        "lock of the node's reference (GNSS, 10 MHz)",
        "methods/bench/links.py",
    ),
    "clock_drifts": Flag(
        "frequency drift over the recording, ppm",
        "the clock frequency drifts during the recording",
        "warm-up; lock of the node's reference",
        "methods/bench/links.py",
    ),
    "path_offset_disagrees": Flag(
        "path offset measured on the set-up, path offset configured",
        "the configured path offset differs from the measured one",
        "nodes.<n>.path_offset_m; bench.radar_m, bench.sidelink_m",
        "methods/bench/links.py",
    ),
    "splitter_channels_differ": Flag(
        "differences of gain and phase over the band",
        "two channels that are fed by one signal differ",
        "splitter and cables; filters of both channels; path offsets",
        "methods/bench/links.py",
    ),
}
"""Flags of bench recordings: name → row."""

FLAGS = _OF_BENCHES | _OF_RECORDINGS | _OF_IMAGES
"""All flags: name → row, those of a bench first."""
