"""What has come and gone: the counters of the service, read when somebody asks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Traffic:
    """What went over a link since the service started."""

    link: str
    bytes_in: int
    bytes_out: int
    frames_in: int  # whole, and taken for their signatures
    frames_out: int  # handed to the link, once for each peer
    dropped_out: int  # of these, frames that a peer did not get
    connections: int  # how often it came up
    peers: int  # now
    dropped_in: int = 0  # datagrams and connections of those who want too much


@dataclass(frozen=True, slots=True)
class Account:
    """The counters of the service.

    Attributes
    ----------
    dropped : mapping
        Frames lost in parsing, by reason.
    rejected : mapping
        Frames not taken for their signatures, by `LINK: REASON`.
    assembly : mapping
        `EpochAssembler.counts`.
    unused : mapping
        `Ingest.counts`.
    links : sequence of Traffic
    """

    dropped: Mapping[str, int]
    rejected: Mapping[str, int]
    assembly: Mapping[str, int]
    unused: Mapping[str, int]
    links: Sequence[Traffic]


@dataclass(frozen=True, slots=True)
class MqttCounts:
    """What became of the messages to the broker."""

    is_up: bool  # the broker has taken us in
    connections: int  # how often it did
    published: Mapping[str, int]  # by topic
    dropped: Mapping[str, int]  # likewise: nobody got them
    waiting: Mapping[str, int]  # likewise
