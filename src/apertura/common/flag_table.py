"""Flags of an image: quantity measured, meaning, advice, module. docs/flags.md is generated from this table.

Rows are in processing order, from recording to image. `Flags` uses only the names.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Flag:
    """Row of the flag table: a flag is raised if a limit of a method is exceeded.

    Parameters
    ----------
    measured
        Quantity that the flag's line reports, with its unit.
    meaning
        Consequence for the image.
    advice
        Item to check first, or remedy.
    raised
        Module that raises the flag, relative to src/apertura; several modules are separated by commas.

    Examples
    --------
    >>> Flag("fraction of the samples", "samples at full scale", "gain", "core/echo/captures.py").advice
    'gain'
    """

    measured: str
    meaning: str
    advice: str
    raised: str


# ---- Recordings, flight logs, clocks and sidelinks

_OF_RECORDINGS = {
    "association_ambiguous": Flag(
        "time offset between the nodes' time tags, in s and in pulse intervals",
        "the time offset is close to half a pulse interval: pulses may be paired with an adjacent pulse",
        "frame counters; clocks of the nodes",
        "core/echo/association.py",
    ),
    "association_sparse": Flag(
        "paired fraction of the pulses of the shorter recording",
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
        "time offset between the nodes' time tags, s, and distance flown in that time, m",
        "time tags of the nodes differ by more than 20 ms: positions are evaluated at the wrong time",
        "time system of each node",
        "core/echo/association.py",
    ),
    "time_tag_outlier": Flag(
        "pulses dropped, deviation of their time tags",
        "single time tags deviate from the line fitted to all time tags",
        "triggers of both nodes",
        "core/echo/association.py",
    ),
    "pulses_unpaired": Flag(
        "unpaired pulses before and after the other recording",
        "more than 5 % of the transmitted pulses lie outside the other recording",
        "start and end of the recordings; time tags delayed by an integer number of pulse intervals",
        "core/echo/association.py",
    ),
    "fix_quality_low": Flag(
        "pulses dropped, per node",
        "the fix type of the log is below the configured minimum",
        "the flight log; nodes.<n>.worst_fix",
        "stages/positions.py",
    ),
    "alignment_ambiguous": Flag(
        "the other clock offset; contrast of this clock offset relative to that of the best clock offset, dB",
        "another clock offset, or every clock offset, focuses the image nearly as well",
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
        "contrast of the best clock offset relative to the others, dB",
        "the contrast of the best clock offset is hardly higher than that of the others",
        "position of the point; path offset; correspondence of flight log and recording",
        "methods/alignment/on_point.py",
    ),
    "scans_incomplete": Flag(
        "scans excluded",
        "messages of scans are missing, damaged or truncated",
        "the recorder; the copy of the file",
        "formats/phase_histories/pulson.py",
    ),
    "sweep_idle": Flag(
        "decrease of the power along the sweep, dB; its time after the start of the sweep; waveform.sweep_s, s",
        "the end of the rows contains only noise: the sweep ends earlier than configured, which scales ranges wrongly",
        "waveform.sweep_s and waveform.bandwidth_hz, which are those of the linear part without idle time",
        "core/echo/dechirp.py",
    ),
    "sweep_motion": Flag(
        "path change per sweep, wavelengths; displacement of echoes, m",
        "the antennas move during a sweep: envelope and phase of an echo correspond to different ranges",
        "waveform.sweep_s; a slower flight, or stops while sweeping",
        "core/echo/dechirp.py",
    ),
    "track_epochs_dropped": Flag(
        "epochs excluded, by reason",
        "epochs that have no fix, are damaged or are duplicates were excluded",
        "the flight log, if track_gap is also raised; otherwise no action is needed",
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
        "rate of the flight log; missing epochs",
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
        "platform stationary: these pulses would increase the weight of a single aspect angle",
        "config/segments.tsv, which takes precedence for the pairs listed in it",
        "stages/positions.py",
    ),
    "track_frozen": Flag(
        "pulses dropped, epochs, largest deviation",
        "epochs repeat the previous position",
        "output rate of the GNSS receiver compared with the rate of the log",
        "stages/positions.py",
    ),
    "track_positions": Flag(
        "position error, m",
        "coordinates of the flight log are rounded too coarsely",
        "number of decimals of the log's coordinates: 8 for degrees, 6 for minutes (NMEA)",
        "stages/positions.py",
    ),
    "track_times": Flag(
        "position error along the track, m",
        "times of the flight log are rounded too coarsely",
        "number of decimals of the log's times",
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
        "single pulses may be paired with an adjacent pulse",
        "frame counters",
        "core/echo/association.py",
    ),
    "association_suspect": Flag(
        "difference between the measured sidelink path and that computed from the geometry, m",
        "the sidelink contradicts the geometry: pulses are paired wrongly, or positions are wrong",
        "time tags, flight logs, lever arms",
        "core/echo/transfer.py",
    ),
    "reference_point": Flag(
        "largest difference between the stated delay of the reference point and that computed from the positions, in s "
        "and in m of path",
        "CPHD: positions and times of the pulses contradict each other",
        "the software that wrote the file; focus of the image",
        "formats/phase_histories/cphd.py",
    ),
    "captures_repeated": Flag(
        "captures, sweeps or pulses excluded, of the total number; number of the first",
        "captures are bit-identical to earlier ones: the recorder wrote old samples again, which would cause ghosts; "
        "if all are identical, none is excluded from a phase history or from FMCW sweeps",
        "buffers of the recorder; the copy of the recording",
        "core/echo/captures.py",
    ),
    "captures_limited": Flag(
        "captures affected, of the total number; crest factors of these and of the other captures, dB",
        "some captures are limited below full scale: their echoes are attenuated and distorted",
        "limiter, gain control and gain of the receiver",
        "core/echo/captures.py",
    ),
    "saturated_radar": Flag(
        "fraction of the samples; number of captures, and their power relative to the other captures, dB",
        "samples are at full scale of the converter",
        "gain; if a few captures have a much higher power than the others: interference",
        "core/echo/captures.py",
    ),
    "saturated_sidelink": Flag(
        "fraction of the samples; number of captures, and their power relative to the other captures, dB",
        "samples are at full scale of the converter",
        "gain; if a few captures have a much higher power than the others: interference",
        "core/echo/captures.py",
    ),
    "gain_step": Flag(
        "change of the power, dB; number and time of the pulse; number of steps",
        "the power of the pulses changes within one pulse interval and does not return: the gain changed, and levels "
        "of the image are wrong",
        "gain control of the recorder and of the transmitter; several recordings in one file; persistent interference; "
        "blockage of the sidelink",
        "core/echo/gain_step.py",
    ),
    "code_unconfirmed": Flag(
        "strongest echo relative to the level beyond the prefix, dB; or share of signals that are not compressed",
        "the code compresses no echo within the prefix or listening time, although the captures contain signals",
        "waveform.codes (file, number of rows, seed, frame numbers), waveform.pulse; another transmitter",
        "core/echo/own_pulses.py",
    ),
    "phase_unstable": Flag(
        "second differences of phase, rad rms; stability of the magnitude",
        "echoes have a stable magnitude but no stable phase: the image is speckle",
        "oscillator of the node; assignment of the transmitter",
        "core/echo/own_pulses.py",
    ),
    "wrong_code": Flag(
        "SNR of the sidelink",
        "the sidelink does not contain the configured code: the configured code is wrong if all pairs of the "
        "transmitter have this flag; otherwise the sidelink received another transmitter",
        "waveform.codes, waveform.carrier_is, waveform.iq, nodes.<n>.iq; the recording",
        "core/echo/sidelink_state.py",
    ),
    "background": Flag(
        "increase of the image noise by arcs of the background, dB; reason why the background is not removed",
        "echoes at constant delay, such as antenna coupling, cause arcs at constant range",
        "processing.background; isolation of the antennas",
        "core/imaging/background.py",
    ),
    "background_loss": Flag(
        "largest peak loss of a target, dB",
        "the removed background contains part of the echoes of targets whose range hardly changes",
        "processing.background: none; a longer track",
        "core/imaging/background.py",
    ),
    "sidelink_lost": Flag(
        "pulses dropped",
        "pulses without a sidelink were dropped",
        "blockage; antenna of the sidelink",
        "core/echo/sidelink_state.py",
    ),
    "symbols_unsure": Flag(
        "pulses excluded; or SNR of the sidelink and required SNR, dB",
        "the data symbols of pulses are unsure; of most pulses: bistatic echoes are divided by the noisy sidelink",
        "SNR and reflections of the sidelink; waveform.codes: constellation, pilots",
        "core/echo/decided_symbols.py",
    ),
    "constellation_suspect": Flag(
        "constellation with such an occupancy, and mean power of the decided symbols, dB; or kurtosis of their errors",
        "the decided data symbols do not occupy the points of the configured constellation uniformly, or their errors "
        "are those of a larger constellation: another one was sent, which changes the amplitude of images, or the data "
        "are not scrambled, which does not",
        "waveform.codes.constellation; scrambling of the data",
        "core/echo/decided_symbols.py",
    ),
    "header_differs": Flag(
        "wrong bits of the header, and number expected from the SNR, %",
        "the decided symbols do not begin with the configured header: decisions or configuration are wrong, or frames "
        "of another transmitter were received",
        "waveform.codes: constellation, pilots, frame.header; waveform.iq, nodes.<n>.iq; another transmitter",
        "core/echo/decided_symbols.py",
    ),
    "sidelink_spikes": Flag(
        "pulses whose sidelink phase deviates, rad and cm; pulses excluded; loss by the others, dB",
        "the sidelink is disturbed in individual pulses; the echoes of these pulses are not affected",
        "rotors and airframe in the line of sight; place of the sidelink antenna; interference",
        "core/echo/sidelink_spikes.py",
    ),
    "sidelink_modulation": Flag(
        "frequency or an alias of it, Hz; depth of phase and amplitude, rad and dB; ghosts, dB",
        "the sidelink is modulated periodically: ghosts along track, unless the echo has the same modulation",
        "reflection from rotors; vibration of the oscillator; place of the sidelink antenna",
        "core/echo/sidelink_spikes.py",
    ),
    "second_arrival": Flag(
        "level of the second path relative to the direct path, dB; delay of the second path",
        "a second path is nearly as strong as the direct path",
        "a second transmitter; reflections",
        "core/echo/sidelink_state.py",
    ),
    "sidelink_nulls": Flag(
        "fraction of subcarriers far below the mean level",
        "parts of the band are down-weighted instead of being corrected",
        "reflections at the sidelink antenna",
        "core/echo/sidelink_state.py",
    ),
    "sidelink_noisy": Flag(
        "SNR of the sidelink and required SNR",
        "the SNR is below the minimum that the correction requires",
        "processing.sidelink: auto selects another correction",
        "core/echo/sidelink.py",
    ),
    "sidelink_echo": Flag(
        "level of the echo relative to the direct path, dB",
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
        "level and path of the second arrival relative to the direct path, dB and m",
        "the second arrival may be an echo, which causes errors of path and phase",
        "reflections at the sidelink antenna",
        "core/echo/sidelink_state.py",
    ),
    "sidelink_code": Flag(
        "correction requested",
        "the sidelink does not contain the code that the correction requires",
        "waveform.codes",
        "core/echo/sidelink.py",
    ),
    "frames_displaced": Flag(
        "frames by which the symbols of captures differ from their frame numbers",
        "the symbols of other frames were found in the captures: the first triggers are missing, or the table of codes "
        "begins with another frame; numbers by order of captures are corrected, those of a frame counter are not",
        "first captures of the transmitter; rows of waveform.codes; frame counter",
        "stages/echo.py",
    ),
    "symbols_noise": Flag(
        "SNR loss by symbols of varying modulus, and smallest loss, dB",
        "the requested filter of the symbols loses more SNR than another one",
        "processing.symbol_filter: auto",
        "core/echo/symbol_filter.py",
    ),
    "symbols_sidelobes": Flag(
        "level of data sidelobes, dB; number of different frames",
        "the requested filter leaves echo amplitudes that vary with the data, which spread each point over all ranges",
        "processing.symbol_filter: auto or reciprocal",
        "core/echo/symbol_filter.py",
    ),
    "waveform_sidelobes": Flag(
        "range sidelobes of every point, dB",
        "the spectrum of the filtered pulse is uneven, which causes range sidelobes",
        "waveform.filter, waveform.band_hz",
        "core/echo/pulse_filter.py",
    ),
    "waveform_noise": Flag(
        "SNR loss, dB; fraction of the band with little energy",
        "division by the pulse's spectrum amplifies noise where the pulse has little energy",
        "waveform.band_hz; waveform.filter",
        "core/echo/pulse_filter.py",
    ),
    "pulse_truncated": Flag(
        "pulses whose direct path is truncated by the capture",
        "captures truncate the direct pulse: division by its spectrum causes sidelobes and loses energy",
        "waveform.lead_s; trigger of the receiver",
        "core/echo/pulse_filter.py",
    ),
    "clock_ambiguous": Flag(
        "carrier frequency offset and half the subcarrier spacing, Hz",
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
        "the clock offset is not measured: captures are too short, or the pulse is neither repeated nor divided out",
        "length of the captures; processing.sidelink",
        "core/echo/transfer.py",
    ),
    "calibration_uncertain": Flag(
        "path offset, measured scatter, tolerated scatter",
        "the scatter of the path offset exceeds the tolerance of an image",
        "the reflector; the track",
        "core/echo/calibration.py",
    ),
    "calibration_ambiguous": Flag(
        "level of the second reflector relative to the first, dB; path offset of the second reflector",
        "a second reflector is nearly as strong as the first",
        "calibration.search_m",
        "core/echo/calibration.py",
    ),
}
"""Flags raised before image formation: name → row."""


# ---- Scene, plan, track refinement, image and sums of pairs

_OF_IMAGES = {
    "platform_inside_scene": Flag(
        "pulses above the scene",
        "the track crosses the scene: echoes from both sides of the track overlap",
        "scene.bounds_m",
        "core/planning/plan.py",
    ),
    "platform_below_scene": Flag(
        "height of the antenna below the lowest terrain of the scene, m",
        "an antenna is below all DEM heights in its surroundings",
        "unit and vertical datum of scene.dem",
        "core/scene/clearance.py",
    ),
    "terrain_step": Flag(
        "height and horizontal width of the step, m; position of the step",
        "the DEM has a step steeper than 79 degrees",
        "voids filled with a constant; seams of the DEM; no action is needed for a real cliff",
        "stages/scene.py",
    ),
    "outside_swath": Flag(
        "fraction of the scene; integration angle",
        "no pulse illuminates part of the scene within the integration angle: these pixels are nodata",
        "scene.bounds_m; processing.integration",
        "core/planning/decisions.py",
    ),
    "track_turns": Flag(
        "range of aspect angles; integration angle",
        "the track turns or reverses: the resolution differs between directions",
        "config/segments.tsv, to image the passes separately",
        "core/planning/decisions.py",
    ),
    "no_aperture": Flag(
        "length of the antennas' track, m",
        "the angle subtended by the aperture at the scene is too small for image formation",
        "kind bench in flights.tsv; the flight log; config/segments.tsv",
        "core/planning/plan.py",
    ),
    "spacing_coarse": Flag(
        "pixel spacing and size of the finest resolution cell",
        "the pixel spacing exceeds the finest resolution cell by more than 5 %",
        "scene.spacing_m",
        "core/planning/plan.py",
    ),
    "azimuth_undersampled": Flag(
        "Doppler spread, cycles per pulse; aliased fraction of the scene; level of the ambiguities, dB",
        "the aperture is undersampled: azimuth ambiguities are visible",
        "scene.bounds_m; flight speed and waveform.prf_hz",
        "core/planning/plan.py",
    ),
    "pulses_missing": Flag(
        "number of missing pulses; level of the sidelobes caused by missing pulses, dB",
        "missing pulses cause sidelobes along the track above −20 dB",
        "section pulses of image.json: pulses dropped, with reasons",
        "core/echo/association.py",
    ),
    "scene_beyond_recording": Flag(
        "fraction of the scene not recorded by all pulses, and fraction recorded by none; number of pulses; longest "
        "total path and recorded total path",
        "echoes of part of the scene arrive after the recorded delays: these pixels are formed from fewer pulses or "
        "have no data",
        "scene.bounds_m; scene.height_m if it is the default; looks.tif and nesz.tif of these pixels",
        "stages/planning.py",
    ),
    "scene_beyond_samples": Flag(
        "fraction of the scene's interval of total paths",
        "range profiles do not cover the scene (only in calls from Python)",
        "the range window to which the profiles were cropped",
        "core/imaging/job.py",
    ),
    "outside_beam": Flag(
        "fraction of the scene",
        "part of the scene lies outside the antenna beams at every pulse",
        "boresights; scene.bounds_m",
        "core/antenna/illumination.py",
    ),
    "antenna_phase": Flag(
        "peak loss and displacement of a point, dB and cm",
        "the phase of the antenna patterns changes over the aperture",
        "lever_arms_m, which must end at the phase centre; phase_deg of the pattern",
        "core/quality/budget.py",
    ),
    "refinement_rejected": Flag(
        "increase of the contrast of held-out points and required increase, dB",
        "the contrast of held-out points did not increase significantly, or the refinement displaced a track by a "
        "wavelength: the unrefined tracks are used",
        "position_std_m of the nodes; SNR; docs/howto/refine_tracks.md",
        "methods/autofocus/evidence.py",
    ),
    "refinement_no_bright_point": Flag(
        "minimum contrast of a bright point",
        "no bright point for track refinement: the unrefined tracks are used",
        "reflectors in the scene; processing.autofocus: off",
        "methods/autofocus/patches.py",
    ),
    "cause_corrected": Flag(
        "cause, magnitude of the error, explained loss, dB",
        "the error of a configured constant explains the loss better than track errors: images are formed with the "
        "corrected constant",
        "the constant named in the flag: lever_arms_m or attitude, config/clocks.tsv, scene.height_m",
        "methods/autofocus/cause_fit.py",
    ),
    "path_offsets_differ": Flag(
        "path difference and its standard deviation, cm",
        "after refinement, the paths of bright points differ by a constant between the pairs",
        "nodes.<n>.path_offset_m of the pair's receiver; lever arms",
        "methods/autofocus/refine.py",
    ),
    "position_error_understated": Flag(
        "estimated track errors relative to the configured position accuracy",
        "estimated track errors are much larger than the configured position accuracy",
        "position_std_m, position_correlation_s; lever arms, heights, times",
        "methods/autofocus/evidence.py",
    ),
    "position_error_overstated": Flag(
        "estimated track errors relative to the configured position accuracy",
        "estimated track errors are much smaller than the configured position accuracy: a smaller configured value "
        "would constrain the refinement better",
        "position_std_m, position_correlation_s",
        "methods/autofocus/evidence.py",
    ),
    "cycle_slip_suspected": Flag(
        "sections of the track and their displacement",
        "sections of the refined track may be displaced by a wavelength",
        "position_std_m; more bright points",
        "methods/autofocus/evidence.py",
    ),
    "defocused": Flag(
        "peak loss of bright points, dB; peak loss predicted by the error budget, dB",
        "phase errors reduced the peaks of bright points by more than 1 dB",
        "the hypothesis, if one is given in the flag message; positions, lever arms, heights, times",
        "core/imaging/focus_check.py",
    ),
    "loss_unexpected": Flag(
        "measured and predicted peak loss of bright points, dB, with standard deviations",
        "the peak loss is at most 1 dB, but it exceeds the error budget by three standard deviations, or correction of "
        "the cause identified in another image removes it",
        "nodes.<n>.position_std_m, scene.height_std_m and time_tag_std_s, which may be too optimistic",
        "core/imaging/focus_check.py",
    ),
    "focus_uneven": Flag(
        "number of points, and their loss, dB; median loss; position and loss of the worst point",
        "single bright points are defocused although most are focused: they moved, or the geometry is wrong by amounts "
        "that depend on the position, such as heights, reference point, carrier, or the sign of the phase",
        "heights of these points, scene.dem; sign convention of a phase history; carrier; moving objects",
        "core/imaging/focus_check.py",
    ),
    "range_defocused": Flag(
        "peak loss of bright points by phase errors over frequency, dB, with standard deviation; quadratic phase, rad",
        "phase errors over frequency reduced the peaks of bright points by more than 1 dB and smear points in range",
        "the waveform in the configuration: chirp rate, pulse file, sweep and bandwidth; nonlinearity of the sweep; "
        "filters",
        "core/imaging/focus_check.py",
    ),
    "echo_outside_scene": Flag(
        "position of the strong echo",
        "the pulses contain a strong echo at ranges outside the scene, or a strong echo that does not focus at any "
        "position",
        "heights and vertical datum of log and scene; scene.bounds_m; path offsets; swapped I and Q: waveform.iq, or "
        "conjugated samples in calls from Python",
        "core/imaging/focus_check.py",
    ),
    "pairs_displaced": Flag(
        "displacement of the points to the east and north, cm",
        "bright points of a pair are displaced relative to the other pairs, or no majority of the pairs agrees on "
        "the position of the points",
        "the hypothesis, if one is given in the flag message; path offsets, lever arms, scene.height_m",
        "stages/assess.py",
    ),
    "pairs_out_of_phase": Flag(
        "phase relative to the pairs that agree",
        "bright points of a pair differ in phase from the other pairs, or no majority of the pairs agrees: the pair is "
        "excluded from the coherent sum",
        "path offsets; processing.fusion.align_phase",
        "stages/assess.py",
    ),
    "pair_excluded": Flag(
        "pair, reason, phase correction that would align the pair",
        "a pair is excluded from the coherent sum",
        "flags of that pair; processing.fusion.align_phase",
        "stages/export.py",
    ),
    "phase_unobservable": Flag(
        "pair, reason, peak loss caused by a wrong phase, dB",
        "the phase offset of a pair in the coherent sum is not observable; a wrong phase splits targets",
        "the remedy given in the flag message: a finer scene.spacing_m, a reflector in the scene, or a calibration "
        "flight",
        "stages/export.py",
    ),
    "sum_incoherent": Flag(
        "fraction of the power at bright points that adds in phase; peak loss, dB",
        "pairs of the coherent sum are not in phase: the peaks of the sum are reduced",
        "pairs_out_of_phase, phase_unobservable; positions; processing.fusion.align_phase",
        "stages/export.py",
    ),
    "flights_displaced": Flag(
        "displacement of the points to the east and north, cm",
        "bright points of two flights are displaced relative to each other",
        "base station, datum, time system of one flight",
        "stages/assess.py",
    ),
    "pair_unconfirmed": Flag(
        "number of common bright points",
        "the number of bright points that a pair has in common with other pairs is not statistically significant",
        "SNR of the pair's echo; names of the pair's channels",
        "stages/assess.py",
    ),
    "pair_uncalibrated": Flag(
        "file of calibration constants, pair",
        "no calibration constant is available for the pair: backscattering coefficients have no values",
        "a reflector within the beams of the pair; transmit_power_dbm and receivers of the pair's nodes",
        "stages/layers.py",
    ),
    "constant_drifts": Flag(
        "difference between flights or calibrations and its standard deviation, dB or rad",
        "the calibration constant or phase changed by more than three standard deviations",
        "cables, gains, temperature; pointing of the antennas",
        "tools/reflectors.py",
    ),
    "reflectors_disagree": Flag(
        "reflectors; sum of squared residuals and its probability",
        "calibration constants of the reflectors disagree: the standard deviation of the constant was increased",
        "positions, sizes and orientations of the reflectors; other echoes; antenna patterns",
        "tools/reflectors.py",
    ),
    "constant_disagrees": Flag(
        "difference between the calibration constant computed from the config and the constant measured on "
        "reflectors, dB, and in standard deviations",
        "the config contradicts the reflectors; the constant measured on the reflectors was used",
        "transmit_power_dbm, antenna gains, receiver",
        "stages/radiometry.py",
    ),
    "noise_disagrees": Flag(
        "measured noise relative to the configured noise figure, or relative to the noise at the measurement of the "
        "reflectors, dB",
        "possible causes of excessive noise are interference, too little gain, and a wrong gain or full scale; a noise "
        "that is too low indicates a wrong gain or full scale, and all cross-sections have the same error",
        "nodes.<n>.receiver: gain_db, full_scale_dbm or full_scale_v, full_scale_counts, noise_figure_db",
        "stages/radiometry.py",
    ),
    "engine_replaced": Flag(
        "tiles; requested engine and engine used; accuracy",
        "the requested engine does not meet the requested accuracy: another engine formed the image, or some tiles of "
        "the image",
        "processing.engine: auto, or a coarser processing.accuracy_db",
        "core/planning/plan.py",
    ),
    "accuracy_not_met": Flag(
        "upper bound of the error and requested accuracy, dB",
        "the 95 % upper bound of the numerical error exceeds the requested accuracy",
        "processing.accuracy_db, processing.engine",
        "core/imaging/certify.py, core/imaging/backproject.py",
    ),
    "interferogram_decorrelated": Flag(
        "fraction of pixels with significant coherence; measured coherence, expected coherence of unrelated images, "
        "upper limit set by the geometry",
        "the two images have little coherence: neither phase nor height is usable",
        "baseline of the tracks; changes between the flights; focus of both images",
        "methods/interferometry/comparison.py",
    ),
    "inputs_copied": Flag(
        "files with the same content",
        "recordings or logs of two flights are copies of the same file: the images are not independent",
        "the recordings and logs in raw/ of both flights",
        "stages/tags.py",
    ),
    "stack_flight_excluded": Flag(
        "reason: coherence, residual phase in rad, or fraction of the windows that follow one residual track",
        "the flight does not fit into the stack and is left out of its list of flights",
        "tracks and focus of the flight; baseline; changes of the terrain; processing.autofocus; stack.window_px",
        "methods/stack/limits.py",
    ),
    "stack_residual_phase": Flag(
        "standard deviation of the residual phase over stable windows, rad; number of coherent windows",
        "phases of the flight have errors of more than 0.3 rad on terrain that does not move",
        "position accuracy of the logs; processing.autofocus; a DEM",
        "methods/stack/limits.py",
    ),
    "stack_motion_defocuses": Flag(
        "rms phase of the residual track over the aperture, rad",
        "the residual track varies during the aperture: it displaces and defocuses points, which the removed phase "
        "does not correct",
        "processing.autofocus; position accuracy of the logs",
        "methods/stack/limits.py",
    ),
    "stack_decorrelated": Flag(
        "median coherence with the reference flight, and its expected value",
        "the images are less coherent than noise, baseline and residual motion explain",
        "changes of the terrain between the flights; vegetation; focus of both images",
        "methods/stack/limits.py",
    ),
    "height_insensitive": Flag(
        "fraction of pixels where the height of ambiguity exceeds the height range",
        "the baseline is too short to measure heights",
        "a longer baseline",
        "methods/interferometry/comparison.py",
    ),
    "height_ambiguous": Flag(
        "pixels in unconnected regions, or phase jumps if the phase is not unwrapped; height of ambiguity",
        "heights are ambiguous by multiples of the height of ambiguity, or missing in regions that are not connected",
        "the optional dependency unwrap; a shorter baseline; a wider interferometry.window_px",
        "methods/interferometry/comparison.py",
    ),
    "unwrapping_inconsistent": Flag(
        "phase residues (loops of four pixels); pixels in layover",
        "the phase changes by more than half a cycle per pixel, or is noisy: heights may have errors of integer "
        "multiples of the height of ambiguity",
        "a shorter baseline; a DEM; interferometry.window_px",
        "methods/interferometry/comparison.py",
    ),
    "height_relative": Flag(
        "absence of points of known height in the image",
        "heights are relative to the terrain model; the offset of the heights varies over the scene",
        "scene.reference_points",
        "methods/interferometry/comparison.py",
    ),
    "change_looks": Flag(
        "looks of a window and the required number",
        "the window has too few looks: no change is detected",
        "a wider stack.window_px",
        "methods/change/detection.py",
    ),
    "change_insensitive": Flag(
        "expected coherence; largest significant estimate and mean estimate of other scatterers",
        "the explained coherence is too low to detect replaced scatterers: only changes of amplitude are detected",
        "a shorter baseline; a higher SNR; a wider stack.window_px; a higher stack.change.false_alarm_rate",
        "methods/change/detection.py",
    ),
    "change_decorrelated": Flag(
        "coherence of the scene relative to the expected coherence",
        "the whole scene lost coherence, for example by vegetation or rain: only larger local losses are reported",
        "time between the flights; focus of both images; residual phase of the stack",
        "methods/change/detection.py",
    ),
}
"""Flags of images: name → row."""


# ---- Bench recordings (stationary radar)

_OF_BENCHES = {
    "triggers_missed": Flag(
        "pulses not recorded, of the expected number",
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
        "the signal uses only a few quantisation levels of the converter, which adds quantisation noise",
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
        "I/Q imbalance: each subcarrier leaks into its image frequency",
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
        "the level of the path is hardly above the noise",
        "attenuators, cables, gain; assignment of the channels",
        "methods/bench/links.py",
    ),
    "link_incoherent": Flag(
        "coherence factor Γ, coherence factor if limited only by noise, excess phase noise",
        "the phase scatter of the path exceeds the scatter caused by noise: images suffer the corresponding loss",
        "clock of both channels; sidelink; connectors",
        "methods/bench/links.py",
    ),
    "link_drifts": Flag(
        "phase and delay drift over the recording",
        "phase or delay changes with a stationary set-up",
        "warm-up of cables, amplifiers and filters: wait, or calibrate again",
        "methods/bench/links.py",
    ),
    "delay_jumps": Flag(
        "number of pulses with a different delay; difference from the common delay",
        "delays jump with a stationary set-up: captures start at a different delay, or the strongest path changes",
        "trigger of the transmitter; cables; two reflectors of equal strength",
        "methods/bench/links.py",
    ),
    "interference": Flag(
        "noise of a subcarrier relative to adjacent subcarriers, dB, or power of a tone relative to the rest of the "
        "capture, dB; frequency and its usual service",
        "a narrow-band signal in the band adds noise at every range; subtracted tones cause no sidelobes, excluded "
        "subcarriers do",
        "other transmitters; spurious signals of the node's clocks; processing.interference",
        "methods/bench/links.py, stages/transfer.py, core/echo/interference.py",
    ),
    "interference_pulsed": Flag(
        "proportion of pulses, strongest frequency and its usual service, power relative to the level of echoes and "
        "noise, dB",
        "interference in some subcarriers of single pulses adds noise at every range; pulses are used without these "
        "subcarriers",
        "other transmitters near this frequency; processing.interference",
        "core/echo/interference.py",
    ),
    "interference_sidelink": Flag(
        "proportion of pulses, strongest frequency and its usual service, power relative to the median subcarrier, or "
        "of a tone relative to the rest of the capture, dB",
        "interference in the sidelink: tones are subtracted, and limited subcarriers do not affect its delay and "
        "phase, but interference in the whole band does",
        "other transmitters near this frequency; antenna of the sidelink",
        "core/echo/transfer.py, core/echo/interference.py",
    ),
    "pulses_noisy": Flag(
        "number of pulses; noise relative to neighbouring pulses, dB",
        "interference over the whole band, or coupling that changes from pulse to pulse, adds noise at every range; "
        "these pulses are excluded unless there are too many",
        "transmitters on the UAV, such as telemetry and video; radars nearby; moving parts near the antennas; "
        "processing.interference",
        "core/echo/interference.py",
    ),
    "contact_intermittent": Flag(
        "amplitude change in excess of noise; number of pulses lost or attenuated by 6 dB",
        "the amplitude is unstable with a stationary set-up",
        "connectors of that channel; supply of the amplifiers",
        "methods/bench/links.py",
    ),
    "channel_crosstalk": Flag(
        "level of the sidelink relative to the strongest path, dB",
        "the sidelink leaks into the radar channel, which causes a false echo at short range",
        "shielding, parallel cables, isolation of the channels",
        "methods/bench/links.py",
    ),
    "channels_swapped": Flag(
        "path difference by which the echo arrives before the sidelink, m",
        "the strongest echo arrives before the direct path",
        "order of the channels; bench.radar_m, bench.sidelink_m",
        "methods/bench/links.py",
    ),
    "clock_unlocked": Flag(
        "frequency offset from the transmitter's clock, ppm",
        "the clocks have no common reference: samples are corrected for the measured offset",
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
        "path offset measured on the set-up and configured path offset",
        "the configured path offset differs from the measured path offset",
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
"""All flags: name → row; flags of bench recordings are listed first."""
