"""Every flag that an image may carry: what was measured, what it means, what to look at; docs/flags.md comes of it.

The rows stand in the order in which a recording becomes an image. Only pages and summaries read more than their names.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Flag:
    """A limit of a method that may be crossed.

    Parameters
    ----------
    measured
        What its line tells: the quantity, with its unit.
    means
        What it means for the image.
    look
        What to look at first, or to do.
    raised
        The file that raises it, relative to src/apertura; several with commas between.

    Examples
    --------
    >>> Flag("share of samples", "the converter is full", "gain", "core/echo/captures.py").look
    'gain'
    """

    measured: str
    means: str
    look: str
    raised: str


# ---- Flags of recordings, logs, clocks and sidelinks: what stands before an image ----------------------------------

_OF_RECORDINGS = {
    "association_ambiguous": Flag(
        "distance of the two nodes' tags, s and repetition intervals",
        "tags are nearly half a repetition interval apart: every pair may be off by one pulse",
        "frame counters; the nodes' clocks", "core/echo/association.py"),
    "association_sparse": Flag(
        "pulses paired, of those of the shorter recording", "less than half of the shorter recording found a partner",
        "flights and nodes in flights.tsv; missed triggers", "core/echo/association.py"),
    "frame_counter_conflict": Flag(
        "pulses dropped", "frame counter and time tags disagree at some pulses, which were dropped",
        "the counter's bits", "core/echo/association.py"),
    "time_tags_apart": Flag(
        "distance of the two nodes' tags, s and m flown",
        "tags are more than 20 ms apart: positions are of another moment", "the time system of a node",
        "core/echo/association.py"),
    "time_tag_outlier": Flag(
        "pulses dropped, of all, and how far their tags are off",
        "single tags leave the line through all; their pulses were dropped", "triggers of both nodes",
        "core/echo/association.py"),
    "pulses_unpaired": Flag(
        "pulses of the transmitter before and after the other recording",
        "more than 5 % of the transmitter's pulses lie outside the other recording",
        "start and end of recordings; tags late by whole intervals", "core/echo/association.py"),
    "fix_poor": Flag(
        "pulses dropped, of all, per node",
        "the log's solution is poorer than asked at some pulses, which were dropped", "the log; nodes.<n>.worst_fix",
        "pipeline/opening/positions.py"),
    "alignment_ambiguous": Flag(
        "the other offset, and how many dB it is worse", "another clock offset focuses nearly as well, or all do",
        "a reflector (apertura align --point); a flight with changes of speed",
        "methods/synchronisation/clock_alignment.py"),
    "alignment_at_edge": Flag(
        "the offset, and the range of those tried", "the best clock offset lies at an end of those tried", "--search-s",
        "methods/synchronisation/clock_alignment.py"),
    "alignment_uncertain": Flag(
        "dB of the best offset above the others", "the best clock offset hardly stands out",
        "place of the point; path; which log belongs to the recording", "methods/synchronisation/clock_alignment.py"),
    "scans_incomplete": Flag(
        "scans left out, of all", "scans with missing, damaged or truncated messages were left out",
        "the recorder, or the copy", "formats/phase_histories/pulson.py"),
    "sweep_motion": Flag(
        "wavelengths of path within a sweep, and m that echoes are off",
        "antennas move within a sweep: envelopes of echoes and their phases say different ranges",
        "waveform.sweep_s; fly slower, or stand still while sweeping", "core/echo/dechirp.py"),
    "track_epochs_dropped": Flag(
        "epochs left out, by reason", "epochs of the log without a fix, damaged or doubled were left out",
        "the log, if track_gap comes with it; else nothing", "pipeline/opening/positions.py"),
    "track_gap": Flag(
        "pulses dropped, of all, and the longest gap", "pulses in a gap that the spline does not bridge were dropped",
        "the log's rate and losses", "pipeline/opening/positions.py"),
    "track_outlier": Flag(
        "pulses dropped, outliers found, and the worst of them",
        "epochs of the log were left out, or pulses dropped at a step of it",
        "multipath, cycle slips, the log's export", "pipeline/opening/positions.py"),
    "hover": Flag(
        "pulses dropped, of all, how long the antennas stood, and from when",
        "pulses sent while the antennas stood still were dropped: all would weigh on one direction",
        "config/segments.tsv, which alone decides for the pairs it names", "pipeline/opening/positions.py"),
    "track_frozen": Flag(
        "pulses dropped, epochs found, and the worst of them",
        "epochs that repeat the position before them were left out", "rate of the receiver against that of the log",
        "pipeline/opening/positions.py"),
    "track_times": Flag(
        "m along the flight that positions err by", "rounded times of the log displace positions along the flight",
        "decimals of the log's times", "pipeline/opening/positions.py"),
    "attitude_suspect": Flag(
        "degrees that yaw is off the course over ground, as logged and by another convention",
        "attitude looks like radians, or anticlockwise: lever arms and beams turn wrongly",
        "the log's export; nodes.<n>.attitude course, or none", "pipeline/opening/positions.py"),
    "time_tag_jitter": Flag(
        "scatter of the tags, s rms, and the repetition interval",
        "tags scatter so that single pulses may pair with a neighbour", "frame counters", "core/echo/association.py"),
    "association_suspect": Flag(
        "m by which the sidelink leaves its geometry, and at which pulse",
        "the sidelink's path does not move as geometry says: pairs or positions are wrong", "tags, logs, lever arms",
        "core/echo/transfer.py"),
    "reference_point": Flag(
        "s and m of path between reception and reference point, of the worst pulse",
        "CPHD: positions and times of pulses contradict each other by more than any atmosphere",
        "the file's writer; whether the image is sharp", "formats/phase_histories/cphd.py"),
    "saturated_radar": Flag(
        "share of the samples at the end stops", "samples at the end stops of the converter", "gain",
        "core/echo/captures.py"),
    "saturated_sidelink": Flag(
        "share of the samples at the end stops", "samples at the end stops of the converter", "gain",
        "core/echo/captures.py"),
    "code_unconfirmed": Flag(
        "dB of the strongest echo above what lies beyond the prefix",
        "own echoes repeat from pulse to pulse, yet do not gather inside the prefix or listening time",
        "waveform.codes, waveform.pulse; another transmitter", "core/echo/own_pulses.py"),
    "phase_unstable": Flag(
        "second differences of phase, rad rms, and steadiness of magnitude",
        "own echoes keep their magnitude from pulse to pulse and not their phase: speckle",
        "the node's oscillator; which node transmits", "core/echo/own_pulses.py"),
    "wrong_code": Flag(
        "SNR of the sidelink",
        "the sidelink carries another code: of the transmitter if all its pairs say so, else of another transmitter",
        "waveform.codes; the recording", "core/echo/sidelink_state.py"),
    "sidelink_lost": Flag(
        "pulses dropped, of all", "pulses without a sidelink were dropped", "blockage, antenna",
        "core/echo/sidelink_state.py"),
    "second_arrival": Flag(
        "dB of the second path beside the direct one, and its delay",
        "a second path is nearly as strong as the direct one", "two transmitters; reflections",
        "core/echo/sidelink_state.py"),
    "sidelink_nulls": Flag(
        "share of subcarriers far below the mean", "parts of the band are attenuated instead of corrected",
        "reflections at the sidelink antenna", "core/echo/sidelink_state.py"),
    "sidelink_noisy": Flag(
        "SNR of the sidelink, and the SNR needed", "the SNR is below what the correction needs",
        "processing.sidelink, auto chooses another", "core/echo/sidelink.py"),
    "sidelink_echo": Flag(
        "dB of the echo beside the direct path", "an echo in the sidelink makes ghosts", "processing.sidelink",
        "core/echo/sidelink.py"),
    "sidelink_ripple": Flag(
        "dB of ripple over the band that stay", "ripple of the transmitter stays after the correction",
        "processing.sidelink", "core/echo/sidelink.py"),
    "sidelink_ripple_or_echo": Flag(
        "dB and m of the arrival beside the direct path",
        "an arrival beside the direct path may be an echo: paths and phases may err by what is said",
        "reflections at the sidelink antenna", "core/echo/sidelink_state.py"),
    "sidelink_code": Flag(
        "the correction asked for", "the correction needs the code, which the sidelink does not carry",
        "waveform.codes", "core/echo/sidelink.py"),
    "waveform_sidelobes": Flag(
        "dB of sidelobes in range beside every point", "the pulse's filter leaves the band uneven: sidelobes in range",
        "waveform.filter, waveform.band_hz", "core/echo/pulse_filter.py"),
    "waveform_noise": Flag(
        "dB of SNR lost, and the share of the band that lies low",
        "dividing by the pulse amplifies noise where the band holds little energy", "waveform.band_hz; waveform.filter",
        "core/echo/pulse_filter.py"),
    "pulse_cut": Flag(
        "pulses whose captures cut the direct one, of all",
        "captures begin or end inside the direct pulse: divide leaves sidelobes and loses energy",
        "waveform.lead_s; the receiver's trigger", "core/echo/pulse_filter.py"),
    "clock_ambiguous": Flag(
        "carrier offset in Hz, and half a subcarrier", "the carrier offset is close to half a subcarrier",
        "the receiver's oscillator", "core/echo/clock.py"),
    "clock_uncertain": Flag(
        "uncertainty of the carrier offset in Hz, and the floor it makes",
        "the clock is not known well enough for the accuracy asked", "SNR of the sidelink", "core/echo/clock.py"),
    "clock_unmeasured": Flag(
        "why it was not measured",
        "captures are too short to measure the clock, or the pulse does not repeat and is not divided out",
        "length of captures; processing.sidelink", "core/echo/transfer.py"),
    "calibration_uncertain": Flag(
        "path offset and its scatter, and what is needed", "the path offset scatters more than an image allows",
        "the reflector; the track", "core/echo/calibration.py"),
    "calibration_ambiguous": Flag(
        "dB and path offset of the second reflector", "a second reflector is nearly as strong", "calibration.search_m",
        "core/echo/calibration.py"),
}  # fmt: skip
"""Name → what it says; see `apertura.common.flags.FLAGS`."""


# ---- Flags of scenes, plans, refined tracks, images and sums -------------------------------------------------------

_OF_IMAGES = {
    "platform_inside_scene": Flag(
        "pulses above the scene, of all", "the flight passes over the scene: echoes of both sides mix",
        "scene.bounds_m", "core/planning/plan.py"),
    "platform_below_scene": Flag(
        "m below the lowest ground of the scene", "an antenna is lower than all of the DEM beside it",
        "unit and datum of scene.dem", "core/scene/clearance.py"),
    "outside_swath": Flag(
        "share of the scene, and the integration angle",
        "no pulse passes a part of the scene inside the integration angle: it is no data",
        "scene.bounds_m; processing.integration", "core/planning/decisions.py"),
    "integration_turns": Flag(
        "the angle that places are seen under, and the integration angle",
        "the track turns or returns: places are seen under more than the integration angle, and are sharper in some "
        "direction", "config/segments.tsv, to image passes apart", "core/planning/decisions.py"),
    "no_aperture": Flag(
        "m that the antennas moved, and what that resolves across the line of sight",
        "the antennas hardly moved as the scene sees it: an echo per range, and no image",
        "kind bench in flights.tsv; the flight log; config/segments.tsv", "core/planning/plan.py"),
    "spacing_coarse": Flag(
        "spacing of pixels, and the finest resolution cell", "pixels are wider than the finest resolution cell",
        "scene.spacing_m", "core/planning/plan.py"),
    "pulses_sparse": Flag(
        "spread of phase rates over the scene, cycles per pulse; share that folds, and its dB",
        "the aperture is undersampled: azimuth ambiguities show", "scene.bounds_m; speed and waveform.prf_hz",
        "core/planning/plan.py"),
    "pulses_missing": Flag(
        "missing pulses, of all in the aperture, and dB of their sidelobes",
        "pulses missing inside the aperture raise sidelobes above −20 dB along the track",
        "pulses of the echo: what was dropped and why", "core/echo/association.py"),
    "beyond_cyclic_prefix": Flag(
        "share of the scene that arrives too late",
        "echoes of part of the scene arrive after the prefix, or the listening time, of every pulse", "scene.bounds_m",
        "core/planning/plan.py"),
    "scene_beyond_samples": Flag(
        "share of the scene's total paths", "from Python: the profiles given do not reach over all of the scene",
        "how the profiles were cropped", "core/imaging/job.py"),
    "beam_misses": Flag(
        "share of the scene", "no antenna beam sees part of the scene", "boresights; scene.bounds_m",
        "core/antenna/illumination.py"),
    "antenna_phase": Flag(
        "dB that a point in the scene's middle loses, and cm that it is off",
        "the phase of the antennas' patterns changes over the aperture, and is not taken out",
        "lever_arms_m, to the phase centre; phase_deg of the pattern", "core/quality/budget.py"),
    "prediction_misses": Flag(
        "error predicted and accuracy asked, dB", "the plan is expected to miss the accuracy asked",
        "engine and options asked for", "core/planning/planner.py"),
    "refinement_rejected": Flag(
        "dB of contrast gained on places not fitted, its uncertainty, and what is required",
        "places not fitted did not get sharper beyond doubt, or parts of a track are a wavelength off: images are "
        "formed from the logs", "position_std_m of the nodes; SNR; docs/howto/refine_tracks.md",
        "methods/autofocus/evidence.py"),
    "refinement_no_bright_place": Flag(
        "how far places would have to stand out, and what speckle shows",
        "no bright place to refine tracks by: images are formed from the logs",
        "reflectors in the scene; processing.autofocus off", "methods/autofocus/patches.py"),
    "cause_found": Flag(
        "what is wrong, by how much, and dB that it explains",
        "a wrong constant of the config explains the loss of points better than errors of the logs: images are formed "
        "with it corrected", "the constant named: lever_arms_m or attitude, config/clocks.tsv, scene.height_m",
        "methods/autofocus/causes.py"),
    "paths_differ": Flag(
        "cm of path, and standard deviation",
        "from the refined tracks, pairs show the same points a constant path apart",
        "nodes.<n>.path_offset_m of the pair's receiver, lever arms", "methods/autofocus/refine.py"),
    "prior_inconsistent": Flag(
        "how large the motions are against the errors stated",
        "motions found are much larger or smaller than the errors that logs or config state",
        "position_std_m, position_correlation_s; lever arms, heights, times", "methods/autofocus/evidence.py"),
    "cycle_slip_suspected": Flag(
        "parts of the track, and how far off",
        "parts of the refined track see points at another range than the whole: a wavelength off",
        "position_std_m; more bright points", "methods/autofocus/evidence.py"),
    "defocused": Flag(
        "dB lost at bright points, and dB that the budget expects",
        "bright points lost more than 1 dB of their peak to phase errors",
        "the hypothesis named behind it; positions, lever arms, heights, times", "core/imaging/focus_check.py"),
    "loss_unexpected": Flag(
        "dB lost at bright points, and dB that the budget expects, with their deviations",
        "bright points lost at most about 1 dB, yet three deviations more than the budget expects, or what a cause "
        "found in another image of the flight brings back",
        "nodes.<n>.position_std_m, scene.height_std_m, time_tag_std_s: is what they state true?",
        "core/imaging/focus_check.py"),
    "echo_elsewhere": Flag(
        "where the pulses hold the strong echo",
        "nothing bright in the image, yet pulses hold a strong echo: at ranges outside the scene, or that no place "
        "gathers", "heights and datum of log and scene; scene.bounds_m; path offsets; waveform.iq: I and Q swapped",
        "core/imaging/focus_check.py"),
    "pairs_apart": Flag(
        "cm between the places of the points, with its uncertainty, east and north",
        "a pair shows the same points at other places than most, or as many say one place as the other",
        "the hypothesis named behind it; path offsets, lever arms, scene.height_m", "pipeline/steps/assess.py"),
    "pairs_out_of_phase": Flag(
        "phase against the pairs that agree, with its uncertainty",
        "a pair shows the same points in another phase than most, or opinions are even: the coherent sum leaves it "
        "out", "path offsets; processing.fusion.align_phase", "pipeline/steps/assess.py"),
    "pair_left_out": Flag(
        "the pair, why, and the phase that would align it",
        "the coherent sum is without a pair that shows other places, or another phase",
        "the flags of that pair; processing.fusion.align_phase", "pipeline/steps/export.py"),
    "phase_unmeasured": Flag(
        "the pair, why nothing tells its phase, and dB that a wrong one costs",
        "the coherent sum holds a pair whose phase no image tells: if it is wrong, targets split",
        "a reflector in the scene; a calibration flight for the path offsets", "pipeline/steps/export.py"),
    "sum_incoherent": Flag(
        "share of their power that the pairs keep in phase at bright points, and dB lost",
        "the pairs of the coherent sum are not in phase at bright points: its peaks are weaker than theirs",
        "pairs_out_of_phase, phase_unmeasured; positions; processing.fusion.align_phase", "pipeline/steps/export.py"),
    "flights_apart": Flag(
        "cm between the places of the points, with its uncertainty, east and north",
        "two flights show the same points at different places", "base station, datum, time system of one flight",
        "pipeline/steps/cube.py"),
    "pair_unconfirmed": Flag(
        "bright points in common", "a pair shows none of the bright points of another",
        "SNR of its echo; names of its channels", "pipeline/steps/assess.py"),
    "constant_drifts": Flag(
        "dB or rad between flights or since an earlier calibration, and its standard deviation",
        "constant or phase of a pair changed by more than three standard deviations",
        "cables, gains, temperature; what the antennas point at", "pipeline/opening/reflectors.py"),
    "reflectors_disagree": Flag(
        "reflectors, their sum of squares, and how often chance does as much",
        "reflectors of one calibration disagree: the constant's standard deviation was widened",
        "places, sizes, orientation of the reflectors; other echoes in their cells; antenna patterns",
        "pipeline/opening/reflectors.py"),
    "constant_disagrees": Flag(
        "dB between the radio as stated and the constant measured, in standard deviations of both",
        "power, gains and receiver of the config contradict the reflectors, whose constant was used",
        "transmit_power_dbm, gains of antennas, receiver of the nodes", "pipeline/opening/radiometry.py"),
    "noise_disagrees": Flag(
        "dB of the noise measured against the figure stated (0 dB where none is), or that over the reflectors, ± std",
        "above: interference, too little gain, or gain or full scale stated wrong; below: only the latter, and every "
        "cross-section is wrong alike",
        "gain_db, full_scale_dbm or full_scale_v, full_scale_counts and noise_figure_db of nodes.<n>.receiver",
        "pipeline/opening/radiometry.py"),
    "accuracy_missed": Flag(
        "bound of the error, and the accuracy asked, dB", "at 95 %, the error may exceed the accuracy asked",
        "processing.accuracy_db, processing.engine", "core/imaging/certify.py, core/imaging/backproject.py"),
    "interferogram_decorrelated": Flag(
        "pixels more coherent than chance, of all that both images see; coherence, chance, and what geometry leaves",
        "most pixels of two images have nothing in common: no phase, no height",
        "distance of the tracks; changes between the flights; focus of both images",
        "methods/interferometry/comparison.py"),
    "height_insensitive": Flag(
        "pixels where one turn of the phase is more height than the range, of all that both images see",
        "tracks lie too close together to give heights", "tracks further apart",
        "methods/interferometry/comparison.py"),
    "height_ambiguous": Flag(
        "pixels in parts apart, or jumps of the phase where nobody unwraps; height of one turn",
        "heights are known up to multiples of one turn, or left out where parts do not connect",
        "extra unwrap; tracks closer together; a wider interferometry.window_px",
        "methods/interferometry/comparison.py"),
    "unwrapping_inconsistent": Flag(
        "loops of four pixels whose phase contradicts itself, of all; places that several pixels show",
        "the phase changes by over half a turn per pixel, or is noise: heights may err by whole turns",
        "tracks closer together; a DEM; interferometry.window_px", "methods/interferometry/comparison.py"),
    "height_relative": Flag(
        "that no point of known height shows",
        "heights count from the terrain: the phase's constant is unknown, and its error varies over the scene",
        "scene.reference_points", "methods/interferometry/comparison.py"),
}  # fmt: skip
"""Name → what it says; see `apertura.common.flags.FLAGS`."""

# ---- Flags of a radar that stands still ----------------------------------------------------------------------------

_OF_BENCHES = {
    "triggers_missed": Flag(
        "pulses not recorded, of those due", "more than 1 % of the pulses started no capture",
        "trigger level and cable; the recorder's disk", "methods/synchronisation/channels.py"),
    "triggers_false": Flag(
        "captures between two pulses, of all", "something other than the radar's pulses triggered the recorder",
        "trigger level; interference; waveform.prf_hz", "methods/synchronisation/channels.py"),
    "channel_weak": Flag(
        "counts rms of a channel", "the converter hardly sees a signal: quantisation adds noise",
        "gain, attenuators, the channel's cable", "methods/synchronisation/channels.py"),
    "channel_dc": Flag(
        "mean of I and Q, dB of the signal", "a constant in the samples spoils one subcarrier, and so all ranges",
        "offset of the converter, leakage of the local oscillator", "methods/synchronisation/channels.py"),
    "channel_image": Flag(
        "dB of the mirror image", "I and Q are unequal, or not at 90°: subcarriers leak into their mirror images",
        "balance of the mixer; clipping of I or Q", "methods/synchronisation/channels.py"),
    "channel_bits_stuck": Flag(
        "bits that never change", "the converter or its bus holds a bit",
        "data lines of the converter; the recorder's format", "methods/synchronisation/channels.py"),
    "spectrum_inverted": Flag(
        "the node",
        "conjugates of the samples carry the code: I and Q are swapped, or the mixer's oscillator is above the band",
        "order of I and Q in the recorder; the local oscillator's side", "pipeline/opening/bench.py"),
    "link_weak": Flag(
        "dB of a compressed pulse", "the path hardly stands out of the noise: its coherence tells nothing",
        "attenuators, cables, gain; which channel is which", "methods/synchronisation/links.py"),
    "link_incoherent": Flag(
        "Γ, what noise allows, and phase noise beyond it",
        "the phase of the path scatters by more than noise: images lose as much",
        "the clock of both channels; the sidelink's connection; a loose connector", "methods/synchronisation/links.py"),
    "link_drifts": Flag(
        "phase and delay over the recording", "path or delay changes while nothing moves",
        "warm-up of cables, amplifiers, filters: wait, or calibrate again", "methods/synchronisation/links.py"),
    "delay_jumps": Flag(
        "pulses at another delay, and how far off",
        "pulses arrive at several delays while nothing moves: captures begin elsewhere, or another path",
        "trigger of the transmitter; changed cables; two equally strong reflectors",
        "methods/synchronisation/links.py"),
    "interference": Flag(
        "dB by which a subcarrier changes more than the others, and its frequency",
        "a narrow signal in the band adds noise to every range", "other transmitters; spurs of the node's clocks",
        "methods/synchronisation/links.py"),
    "contact_loose": Flag(
        "amplitude beyond noise, per pulse and over the recording; pulses lost or 6 dB low",
        "amplitude is not steady while nothing moves", "connectors of that channel; supply of the amplifiers",
        "methods/synchronisation/links.py"),
    "channel_leaks": Flag(
        "dB of what arrives with the sidelink against the strongest path",
        "the radar channel hears the sidelink: a false echo at short range",
        "shielding, parallel cables, isolation of the channels", "methods/synchronisation/links.py"),
    "channels_swapped": Flag(
        "m that the echo precedes the sidelink", "the strongest echo comes before the direct path",
        "which channel is radar, which sidelink; bench.radar_m and bench.sidelink_m",
        "methods/synchronisation/links.py"),
    "clock_unlocked": Flag(
        "ppm against the transmitter's clock",
        "the clocks share no reference: samples are corrected by the offset measured, as long as it holds",
        "lock of the node's reference (GNSS, 10 MHz)", "methods/synchronisation/links.py"),
    "clock_drifts": Flag(
        "ppm over the recording", "the clock moves during the recording", "warm-up; lock of the node's reference",
        "methods/synchronisation/links.py"),
    "path_disagrees": Flag(
        "path beyond the set-up, and the config's", "the config's path offset is not what was measured",
        "nodes.<n>.path_offset_m; bench.radar_m, bench.sidelink_m", "methods/synchronisation/links.py"),
    "split_disagrees": Flag(
        "gain, phase, and both over the band", "two channels fed by one signal differ",
        "splitter and cables; filters of both channels; path offsets", "methods/synchronisation/links.py"),
}  # fmt: skip
"""Name → what it says; see `apertura.common.flags.FLAGS`."""

FLAGS = _OF_BENCHES | _OF_RECORDINGS | _OF_IMAGES
"""Name → what it says, in the order in which a recording becomes an image; those of a bench first."""
