"""Every flag that an image may carry: what was measured, what it means, what to look at; docs/flags.md comes of it.

The rows stand in the order in which a recording becomes an image. `Flags` reads their names alone.
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
        "distance of the nodes' tags, s and intervals",
        "tags are nearly half an interval apart: pairs may be off by one pulse", "frame counters; the nodes' clocks",
        "core/echo/association.py"),
    "association_sparse": Flag(
        "pulses paired, of the shorter recording", "less than half of the shorter recording found a partner",
        "flights and nodes in flights.tsv; missed triggers", "core/echo/association.py"),
    "frame_counter_conflict": Flag(
        "pulses dropped", "frame counter and time tags disagree", "the counter's bits", "core/echo/association.py"),
    "time_tags_apart": Flag(
        "distance of the nodes' tags, s and m flown", "tags are more than 20 ms apart: positions are of another moment",
        "the time system of a node", "core/echo/association.py"),
    "time_tag_outlier": Flag(
        "pulses dropped, how far tags are off", "single tags leave the line through all", "triggers of both nodes",
        "core/echo/association.py"),
    "pulses_unpaired": Flag(
        "such pulses, before and after", "more than 5 % of the transmitter's pulses lie outside the other recording",
        "start and end of recordings; tags late by whole intervals", "core/echo/association.py"),
    "fix_poor": Flag(
        "pulses dropped, per node", "the log's solution is poorer than asked", "the log; nodes.<n>.worst_fix",
        "stages/positions.py"),
    "alignment_ambiguous": Flag(
        "the other offset, dB that it is worse", "another clock offset focuses nearly as well, or all do",
        "a reflector (apertura align --point); changes of speed", "methods/alignment/on_point.py"),
    "alignment_at_edge": Flag(
        "the offset, the range tried", "the best clock offset lies at an end of those tried", "--search-s",
        "methods/alignment/on_point.py"),
    "alignment_uncertain": Flag(
        "dB of the best offset above the others", "the best clock offset hardly stands out",
        "place of the point; path; which log belongs to the recording", "methods/alignment/on_point.py"),
    "scans_incomplete": Flag(
        "scans left out", "messages of scans are missing, damaged or cut off", "the recorder, or the copy",
        "formats/phase_histories/pulson.py"),
    "sweep_motion": Flag(
        "wavelengths of path per sweep, m that echoes are off",
        "antennas move within a sweep: envelopes and phases of echoes disagree",
        "waveform.sweep_s; fly slower, or stand while sweeping", "core/echo/dechirp.py"),
    "track_epochs_dropped": Flag(
        "epochs left out, by reason", "epochs without a fix, damaged or doubled",
        "the log, if track_gap comes with it; else nothing", "stages/positions.py"),
    "track_log_damaged": Flag(
        "bytes or lines of the log that are no messages", "the log is damaged: epochs are lost, or may be wrong",
        "the medium, or the copy of the log", "stages/positions.py"),
    "track_gap": Flag(
        "pulses dropped, longest gap", "the spline does not bridge the log's gap", "the log's rate and losses",
        "stages/positions.py"),
    "track_outlier": Flag(
        "pulses dropped, outliers, the worst", "epochs of the log stand out, or it has a step",
        "multipath, cycle slips, the log's export", "stages/positions.py"),
    "hover": Flag(
        "pulses dropped, how long the antennas stood",
        "antennas stood still: these pulses would all weigh on one direction",
        "config/segments.tsv, which decides alone where it names the pair", "stages/positions.py"),
    "track_frozen": Flag(
        "pulses dropped, epochs, the worst", "epochs repeat the position before them",
        "rate of the receiver against that of the log", "stages/positions.py"),
    "track_positions": Flag(
        "m that positions err by", "rounded coordinates of the log displace positions",
        "decimals of the log's coordinates: 8 of degrees, 6 of minutes (NMEA)", "stages/positions.py"),
    "track_times": Flag(
        "m along the flight that positions err by", "rounded times of the log displace positions along the flight",
        "decimals of the log's times", "stages/positions.py"),
    "attitude_suspect": Flag(
        "degrees of yaw off the course, as logged and by another convention",
        "attitude looks like radians, or anticlockwise: lever arms and beams turn wrongly",
        "the log's export; nodes.<n>.attitude course, or none", "stages/positions.py"),
    "time_tag_jitter": Flag(
        "scatter of the tags, s rms, and the repetition interval", "single pulses may pair with a neighbour",
        "frame counters", "core/echo/association.py"),
    "association_suspect": Flag(
        "m by which the sidelink leaves its geometry",
        "the sidelink contradicts the geometry: pairs or positions are wrong", "tags, logs, lever arms",
        "core/echo/transfer.py"),
    "reference_point": Flag(
        "s and m of path between reception and reference point, at worst",
        "CPHD: positions and times of pulses contradict each other", "the file's writer; whether the image is sharp",
        "formats/phase_histories/cphd.py"),
    "captures_repeated": Flag(
        "captures left out, of how many; the number of the first",
        "captures repeat earlier ones bit for bit: the recorder wrote old samples again; ghosts without this",
        "buffers of the recorder; the copy of the recording", "stages/echo.py"),
    "captures_limited": Flag(
        "captures, of how many; their crest factor and that of the others, dB",
        "part of the captures is limited below the converter's end stops: echoes are weaker there, and distorted",
        "limiter, gain control and gain of the receiver", "core/echo/captures.py"),
    "saturated_radar": Flag(
        "share of the samples", "samples at the end stops of the converter", "gain", "core/echo/captures.py"),
    "saturated_sidelink": Flag(
        "share of the samples", "samples at the end stops of the converter", "gain", "core/echo/captures.py"),
    "code_unconfirmed": Flag(
        "dB of the strongest echo above what lies beyond the prefix",
        "own echoes repeat, yet do not gather inside the prefix or listening time",
        "waveform.codes, waveform.pulse; another transmitter", "core/echo/own_pulses.py"),
    "phase_unstable": Flag(
        "rad rms of second differences of phase; steadiness of magnitude",
        "own echoes keep their magnitude and not their phase: speckle", "the node's oscillator; which node transmits",
        "core/echo/own_pulses.py"),
    "wrong_code": Flag(
        "SNR of the sidelink",
        "the sidelink carries another code: the transmitter's if all its pairs say so, else another transmitter's",
        "waveform.codes, waveform.carrier_is, waveform.iq, nodes.<n>.iq; the recording", "core/echo/sidelink_state.py"),
    "sidelink_lost": Flag(
        "pulses dropped", "pulses without a sidelink were dropped", "blockage, antenna", "core/echo/sidelink_state.py"),
    "second_arrival": Flag(
        "dB of the second path, its delay", "a second path is nearly as strong as the direct one",
        "two transmitters; reflections", "core/echo/sidelink_state.py"),
    "sidelink_nulls": Flag(
        "share of subcarriers far below the mean", "parts of the band are attenuated instead of corrected",
        "reflections at the sidelink antenna", "core/echo/sidelink_state.py"),
    "sidelink_noisy": Flag(
        "SNR of the sidelink, SNR needed", "the SNR is below what the correction needs",
        "processing.sidelink, auto chooses another", "core/echo/sidelink.py"),
    "sidelink_echo": Flag(
        "dB of the echo beside the direct path", "an echo in the sidelink makes ghosts", "processing.sidelink",
        "core/echo/sidelink.py"),
    "sidelink_ripple": Flag(
        "dB of ripple over the band that stay", "ripple of the transmitter stays after the correction",
        "processing.sidelink", "core/echo/sidelink.py"),
    "sidelink_ripple_or_echo": Flag(
        "dB and m of the arrival beside the direct path",
        "the arrival may be an echo: paths and phases may err by so much", "reflections at the sidelink antenna",
        "core/echo/sidelink_state.py"),
    "sidelink_code": Flag(
        "the correction asked for", "the sidelink lacks the code that the correction needs", "waveform.codes",
        "core/echo/sidelink.py"),
    "waveform_sidelobes": Flag(
        "dB of sidelobes in range beside every point", "the pulse's filter leaves the band uneven: sidelobes in range",
        "waveform.filter, waveform.band_hz", "core/echo/pulse_filter.py"),
    "waveform_noise": Flag(
        "dB of SNR lost, share of the band that lies low",
        "dividing by the pulse amplifies noise where it has little energy", "waveform.band_hz; waveform.filter",
        "core/echo/pulse_filter.py"),
    "pulse_cut": Flag(
        "pulses whose captures cut the direct one",
        "captures cut the direct pulse: divide leaves sidelobes and loses energy",
        "waveform.lead_s; the receiver's trigger", "core/echo/pulse_filter.py"),
    "clock_ambiguous": Flag(
        "carrier offset, half a subcarrier, Hz", "the carrier offset is close to half a subcarrier",
        "the receiver's oscillator", "core/echo/clock.py"),
    "clock_uncertain": Flag(
        "uncertainty of the carrier offset, Hz", "the clock is too uncertain for the accuracy asked",
        "SNR of the sidelink", "core/echo/clock.py"),
    "clock_unmeasured": Flag(
        "why it was not measured", "captures are too short, or the pulse neither repeats nor is divided out",
        "length of captures; processing.sidelink", "core/echo/transfer.py"),
    "calibration_uncertain": Flag(
        "path offset, its scatter, what is needed", "the path offset scatters more than an image allows",
        "the reflector; the track", "core/echo/calibration.py"),
    "calibration_ambiguous": Flag(
        "dB and path offset of the second reflector", "a second reflector is nearly as strong", "calibration.search_m",
        "core/echo/calibration.py"),
}  # fmt: skip
"""Name → what it says; part of `FLAGS`."""


# ---- Flags of scenes, plans, refined tracks, images and sums -------------------------------------------------------

_OF_IMAGES = {
    "platform_inside_scene": Flag(
        "pulses above the scene", "the flight passes over the scene: echoes of both sides mix", "scene.bounds_m",
        "core/planning/plan.py"),
    "platform_below_scene": Flag(
        "m below the lowest ground of the scene", "an antenna is lower than all of the DEM beside it",
        "unit and datum of scene.dem", "core/scene/clearance.py"),
    "terrain_step": Flag(
        "m of height, over m on the ground, its place", "a step of the DEM is steeper than 79 degrees",
        "voids filled with a constant, seams of the DEM; nothing, if it is a cliff", "stages/scene.py"),
    "outside_swath": Flag(
        "share of the scene, integration angle",
        "no pulse passes part of the scene inside the integration angle: no data",
        "scene.bounds_m; processing.integration", "core/planning/decisions.py"),
    "integration_turns": Flag(
        "angle that places are seen under, integration angle",
        "the track turns or returns: places are sharper in some direction",
        "config/segments.tsv, to image passes apart", "core/planning/decisions.py"),
    "no_aperture": Flag(
        "m that the antennas moved", "the antennas hardly moved as the scene sees it: no image",
        "kind bench in flights.tsv; the flight log; config/segments.tsv", "core/planning/plan.py"),
    "spacing_coarse": Flag(
        "spacing, finest resolution cell", "pixels are wider than the finest resolution cell by over 5 %",
        "scene.spacing_m",
        "core/planning/plan.py"),
    "pulses_sparse": Flag(
        "spread of phase rates, cycles per pulse; share that folds, its dB",
        "the aperture is undersampled: azimuth ambiguities show", "scene.bounds_m; speed and waveform.prf_hz",
        "core/planning/plan.py"),
    "pulses_missing": Flag(
        "missing pulses, dB of their sidelobes", "sidelobes of missing pulses along the track exceed −20 dB",
        "pulses of the echo: what was dropped and why", "core/echo/association.py"),
    "beyond_cyclic_prefix": Flag(
        "share of the scene that arrives too late",
        "echoes of part of the scene come after the prefix, or the listening time, of every pulse", "scene.bounds_m",
        "core/planning/plan.py"),
    "scene_beyond_samples": Flag(
        "share of the scene's total paths", "from Python: profiles do not cover the scene",
        "how the profiles were cropped", "core/imaging/job.py"),
    "beam_misses": Flag(
        "share of the scene", "no antenna beam sees part of the scene", "boresights; scene.bounds_m",
        "core/antenna/illumination.py"),
    "antenna_phase": Flag(
        "dB that a point loses, cm that it is off", "the phase of antenna patterns changes over the aperture",
        "lever_arms_m, to the phase centre; phase_deg of the pattern", "core/quality/budget.py"),
    "refinement_rejected": Flag(
        "dB of contrast gained on places not fitted; what is required",
        "places not fitted did not get sharper beyond doubt, or a track is a wavelength off: the logs are used",
        "position_std_m of the nodes; SNR; docs/howto/refine_tracks.md", "methods/autofocus/evidence.py"),
    "refinement_no_bright_place": Flag(
        "how far places would have to stand out", "no bright place to refine tracks by: the logs are used",
        "reflectors in the scene; processing.autofocus off", "methods/autofocus/patches.py"),
    "cause_found": Flag(
        "what is wrong, by how much, dB explained",
        "a wrong constant explains the loss better than errors of the logs: images are formed with it corrected",
        "the constant named: lever_arms_m or attitude, config/clocks.tsv, scene.height_m",
        "methods/autofocus/cause_fit.py"),
    "paths_differ": Flag(
        "cm of path, and standard deviation", "after refinement pairs show points a constant path apart",
        "nodes.<n>.path_offset_m of the pair's receiver, lever arms", "methods/autofocus/refine.py"),
    "prior_inconsistent": Flag(
        "motions against the errors stated", "track errors found are much larger than stated",
        "position_std_m, position_correlation_s; lever arms, heights, times", "methods/autofocus/evidence.py"),
    "prior_too_wide": Flag(
        "motions against the errors stated",
        "track errors found are much smaller than stated: refinement is freer than needed",
        "position_std_m, position_correlation_s", "methods/autofocus/evidence.py"),
    "cycle_slip_suspected": Flag(
        "parts of the track, how far off", "parts of the refined track may be a wavelength off",
        "position_std_m; more bright points", "methods/autofocus/evidence.py"),
    "defocused": Flag(
        "dB lost at bright points, dB that the budget expects",
        "bright points lost more than 1 dB of their peak to phase errors",
        "the hypothesis, where one is named; positions, lever arms, heights, times", "core/imaging/focus_check.py"),
    "loss_unexpected": Flag(
        "dB lost at bright points, dB expected, with deviations",
        "the loss is about 1 dB at most, yet three deviations above the budget, or what a cause of another image "
        "brings back", "are nodes.<n>.position_std_m, scene.height_std_m, time_tag_std_s true?",
        "core/imaging/focus_check.py"),
    "echo_elsewhere": Flag(
        "where the pulses hold the strong echo",
        "pulses hold a strong echo outside the scene's ranges, or that no place gathers",
        "heights and datum of log and scene; scene.bounds_m; path offsets; I and Q swapped: "
        "waveform.iq; from Python, conjugate the samples",
        "core/imaging/focus_check.py"),
    "pairs_apart": Flag(
        "cm between the points, east and north",
        "a pair shows the same points at other places than most, or as many say one place as the other",
        "the hypothesis, where one is named; path offsets, lever arms, scene.height_m", "stages/assess.py"),
    "pairs_out_of_phase": Flag(
        "phase against the pairs that agree",
        "a pair shows points in another phase than most, or opinions are even: the sum leaves it out",
        "path offsets; processing.fusion.align_phase", "stages/assess.py"),
    "pair_left_out": Flag(
        "the pair, why, the phase that would align it", "the coherent sum is without that pair",
        "the flags of that pair; processing.fusion.align_phase", "stages/export.py"),
    "phase_unmeasured": Flag(
        "the pair, why, dB that a wrong phase costs",
        "the phase offset of a pair in the coherent sum is not observable: if wrong, targets split",
        "what the line names: a finer scene.spacing_m, else a reflector in the scene or a calibration flight",
        "stages/export.py"),
    "sum_incoherent": Flag(
        "share of power in phase at bright points, dB lost",
        "pairs of the coherent sum are not in phase: its peaks are weaker than theirs",
        "pairs_out_of_phase, phase_unmeasured; positions; processing.fusion.align_phase", "stages/export.py"),
    "flights_apart": Flag(
        "cm between the points, east and north", "two flights show the same points at different places",
        "base station, datum, time system of one flight", "stages/cube.py"),
    "pair_unconfirmed": Flag(
        "bright points in common", "a pair shows none of the bright points of another beyond chance",
        "SNR of its echo; names of its channels", "stages/assess.py"),
    "pair_uncalibrated": Flag(
        "file of constants, pair", "no constant of the pair is known: backscattering coefficients hold no value",
        "a reflector that serves the pair; transmit_power_dbm and receivers of its nodes", "stages/layers.py"),
    "constant_drifts": Flag(
        "dB or rad between flights or calibrations, standard deviation",
        "constant or phase changed by over three standard deviations",
        "cables, gains, temperature; what the antennas point at", "tools/reflectors.py"),
    "reflectors_disagree": Flag(
        "reflectors, sum of squares, its chance", "reflectors disagree: the constant's standard deviation was widened",
        "places, sizes, orientation of reflectors; other echoes; antenna patterns", "tools/reflectors.py"),
    "constant_disagrees": Flag(
        "dB between the radio stated and the constant measured, in standard deviations",
        "the config contradicts the reflectors, whose constant was used", "transmit_power_dbm, antenna gains, receiver",
        "stages/radiometry.py"),
    "noise_disagrees": Flag(
        "dB of the noise measured against the figure stated, or over the reflectors",
        "above: interference, too little gain, a wrong gain or full scale; below: the latter, and every cross-section "
        "is wrong alike",
        "nodes.<n>.receiver: gain_db, full_scale_dbm or full_scale_v, full_scale_counts, noise_figure_db",
        "stages/radiometry.py"),
    "engine_replaced": Flag(
        "tiles, engine requested and engine used, accuracy",
        "the requested engine misses the requested accuracy: another one formed the image, or some of its tiles",
        "processing.engine auto, or a coarser processing.accuracy_db", "core/planning/plan.py"),
    "accuracy_missed": Flag(
        "bound of the error, accuracy asked, dB", "at 95 %, the error may exceed the accuracy asked",
        "processing.accuracy_db, processing.engine", "core/imaging/certify.py, core/imaging/backproject.py"),
    "interferogram_decorrelated": Flag(
        "pixels more coherent than chance; coherence, chance, what geometry leaves",
        "two images have little in common: no phase, no height",
        "distance of the tracks; changes between the flights; focus of both images",
        "methods/interferometry/comparison.py"),
    "height_insensitive": Flag(
        "pixels where one turn is more height than the range", "tracks lie too close together to give heights",
        "tracks further apart", "methods/interferometry/comparison.py"),
    "height_ambiguous": Flag(
        "pixels in parts apart, or jumps where nobody unwraps; height of one turn",
        "heights are known up to turns, or left out where parts do not connect",
        "extra unwrap; tracks closer together; a wider interferometry.window_px",
        "methods/interferometry/comparison.py"),
    "unwrapping_inconsistent": Flag(
        "loops of four pixels whose phase contradicts itself; places shown twice",
        "over half a turn per pixel, or noise: heights may err by turns",
        "tracks closer together; a DEM; interferometry.window_px", "methods/interferometry/comparison.py"),
    "height_relative": Flag(
        "that no point of known height shows",
        "heights count from the terrain; the error of that varies over the scene", "scene.reference_points",
        "methods/interferometry/comparison.py"),
}  # fmt: skip
"""Name → what it says; part of `FLAGS`."""

# ---- Flags of a radar that stands still ----------------------------------------------------------------------------

_OF_BENCHES = {
    "triggers_missed": Flag(
        "pulses not recorded, of those due", "more than 1 % of the pulses started no capture",
        "trigger level and cable; the recorder's disk", "methods/bench/channels.py"),
    "triggers_false": Flag(
        "captures between two pulses", "something other than the radar's pulses triggered the recorder",
        "trigger level; interference; waveform.prf_hz", "methods/bench/channels.py"),
    "channel_weak": Flag(
        "counts rms of a channel", "the converter hardly sees a signal: quantisation adds noise",
        "gain, attenuators, the channel's cable", "methods/bench/channels.py"),
    "channel_dc": Flag(
        "mean of I and Q, dB of the signal", "a constant in the samples spoils one subcarrier, and so all ranges",
        "offset of the converter, leakage of the local oscillator", "methods/bench/channels.py"),
    "channel_image": Flag(
        "dB of the mirror image", "I and Q are unequal, or not at 90°: subcarriers leak into their mirror images",
        "balance of the mixer; clipping of I or Q", "methods/bench/channels.py"),
    "channel_bits_stuck": Flag(
        "bits that never change", "the converter or its bus holds a bit",
        "data lines of the converter; the recorder's format", "methods/bench/channels.py"),
    "spectrum_inverted": Flag(
        "the node", "I and Q are swapped, or the mixer's oscillator is above the band",
        "order of I and Q in the recorder; the local oscillator's side: waveform.iq, or nodes.<n>.iq of one node",
        "core/echo/transfer.py"),
    "link_weak": Flag(
        "dB of a compressed pulse", "the path hardly stands out of the noise",
        "attenuators, cables, gain; which channel is which", "methods/bench/links.py"),
    "link_incoherent": Flag(
        "Γ, what noise allows, phase noise beyond",
        "the phase of the path scatters by more than noise: images lose as much",
        "clock of both channels; sidelink; connectors", "methods/bench/links.py"),
    "link_drifts": Flag(
        "phase and delay over the recording", "path or delay changes while nothing moves",
        "warm-up of cables, amplifiers, filters: wait, or calibrate again", "methods/bench/links.py"),
    "delay_jumps": Flag(
        "pulses at another delay, how far off",
        "delays jump while nothing moves: captures begin elsewhere, or another path",
        "trigger of the transmitter; cables; two equal reflectors", "methods/bench/links.py"),
    "interference": Flag(
        "dB of a subcarrier's change above the others', its frequency",
        "a narrow signal in the band adds noise to every range", "other transmitters; spurs of the node's clocks",
        "methods/bench/links.py"),
    "contact_loose": Flag(
        "change of amplitude beyond noise; pulses lost or 6 dB low", "amplitude is not steady while nothing moves",
        "connectors of that channel; supply of the amplifiers", "methods/bench/links.py"),
    "channel_leaks": Flag(
        "dB of the sidelink against the strongest path",
        "the radar channel hears the sidelink: a false echo at short range",
        "shielding, parallel cables, isolation of the channels", "methods/bench/links.py"),
    "channels_swapped": Flag(
        "m that the echo precedes the sidelink", "the strongest echo comes before the direct path",
        "order of the channels; bench.radar_m, bench.sidelink_m", "methods/bench/links.py"),
    "clock_unlocked": Flag(
        "ppm against the transmitter's clock",
        "the clocks share no reference: samples are corrected by the offset measured",
        "lock of the node's reference (GNSS, 10 MHz)", "methods/bench/links.py"),
    "clock_drifts": Flag(
        "ppm over the recording", "the clock moves during the recording", "warm-up; lock of the node's reference",
        "methods/bench/links.py"),
    "path_disagrees": Flag(
        "path beyond the set-up, the config's", "the config's path offset is not what was measured",
        "nodes.<n>.path_offset_m; bench.radar_m, bench.sidelink_m", "methods/bench/links.py"),
    "split_disagrees": Flag(
        "gain and phase over the band", "two channels fed by one signal differ",
        "splitter and cables; filters of both channels; path offsets", "methods/bench/links.py"),
}  # fmt: skip
"""Name → what it says; part of `FLAGS`."""

FLAGS = _OF_BENCHES | _OF_RECORDINGS | _OF_IMAGES
"""Name → what it says, in the order in which a recording becomes an image; those of a bench first."""
