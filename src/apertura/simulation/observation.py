"""One pair of nodes as arrays, without files: what sweeps and Monte Carlo studies call thousands of times."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from apertura.simulation.hidden import Hidden, draw, independent_streams
from apertura.simulation.impairments import Impairments
from apertura.simulation.radar import Floats, Waveform
from apertura.simulation.recording import Geometry, receive
from apertura.simulation.scene import Scatterers
from apertura.simulation.synthesis import Channel


@dataclass(frozen=True)
class Observation:
    """A pair's channels, and what the processor is not told.

    Attributes
    ----------
    channels
        `radar` and, where asked for, `sidelink`: for `samples` or `transfer_functions`.
    hidden
        What was drawn of the receiver.
    truth
        Where the antennas truly were.
    noise
        A generator per channel, for their noise.
    """

    channels: Mapping[str, Channel]
    hidden: Hidden
    truth: Geometry
    noise: Mapping[str, Generator]


def observe(
    waveform: Waveform,
    scatterers: Scatterers,
    logged: Geometry,
    generator: Generator,
    *,
    receiver: Impairments,
    transmitter: Impairments | None = None,
    sidelink: bool = True,
) -> Observation:
    """Return what a receiver observes, with its impairments drawn.

    Parameters
    ----------
    waveform
        What is transmitted; its repetition frequency gives the times.
    scatterers
        The scene, in the frame of `logged`.
    logged
        Where the logs say the antennas are; localization errors move the true ones.
    generator
        Everything random.
    receiver
        What is wrong with the receiving node.
    transmitter
        What is wrong with the transmitting node (localization, ripple). None: transmitter and receiver are one
        node, with one position error.
    sidelink
        Whether the second channel is recorded.

    Examples
    --------
    >>> from apertura.simulation.presets import paper_scene, paper_waveform
    >>> from apertura.simulation.synthesis import transfer_functions
    >>> seen = observe(paper_waveform(), *paper_scene(pulses=3), np.random.default_rng(0),
    ...                receiver=Impairments(radar_snr_db=20.0))
    >>> transfer_functions(seen.channels["radar"], seen.noise["radar"]).shape
    (3, 4096)
    """
    time_s = np.arange(len(logged.radar_tx)) / waveform.prf_hz
    streams = independent_streams(generator, 4)
    hidden = draw(receiver, time_s, waveform.sample_rate_hz, streams[0])
    sender, sender_hidden = receiver, hidden
    if transmitter is not None:
        sender, sender_hidden = transmitter, draw(transmitter, time_s, waveform.sample_rate_hz, streams[1])
    truth = replace(
        logged,
        radar_tx=_true(logged.radar_tx, "radar_tx", sender, sender_hidden),
        radar_rx=_true(logged.radar_rx, "radar_rx", receiver, hidden),
        sidelink_tx=_true(logged.sidelink_tx, "sidelink", sender, sender_hidden),
        sidelink_rx=_true(logged.sidelink_rx, "sidelink", receiver, hidden),
    )
    channels = receive(
        waveform,
        scatterers,
        truth,
        impairments=receiver,
        hidden=hidden,
        transmitter=sender,
        sidelink=sidelink,
    )
    return Observation(channels, hidden, truth, {"radar": streams[2], "sidelink": streams[3]})


def _true(logged_m: Floats, point: str, impairments: Impairments, hidden: Hidden) -> Floats:
    wrong = impairments.localization
    return logged_m - hidden.position_error_m if wrong and point in wrong.points else logged_m
