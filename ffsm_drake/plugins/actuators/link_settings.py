"""Settings of the links of the controller: ``effects.link`` and ``effects.sensor_link``."""

from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting

_MOST_SAMPLES = 200  # of a delay


@dataclass
class PacketLosses:
    """Losses and delays of a link with a packet for each control sample."""

    drop_rate: float = setting(0.0, "", "share of lost packets in the long run", least=0, below=1)
    mean_burst: float | None = setting(
        None,
        "packets",
        "mean number of packets that are lost one after another (Gilbert-Elliott channel); null: "
        "losses are independent",
        least=1,
    )
    delay: list[float] = setting(
        [0.0],
        "s",
        "delay of each packet, rounded up to control samples; two numbers: drawn evenly between "
        "them",
        least=0,
        size=(1, 2),
    )
    order: str = setting(
        "kept",
        "",
        'packet that the receiver uses; "kept": packets arrive in their order, and a late packet '
        'delays those after it; "newest": the packet that was sent last among those that have '
        'arrived; "received": the packet that arrives last',
        one_of=("kept", "newest", "received"),
    )
    time: float = setting(0.0, "s", "time at which losses and delays begin", least=0)
    duration: float | None = setting(
        None, "s", "duration of losses and delays; null: to the end of the run", above=0
    )
    period: float | None = setting(
        None, "s", "time from one beginning to the next; null: they begin once", above=0
    )
    seed: int | None = setting(
        None, "", "seed of the draws; null: ``random_seed``", least=0, most=2**31 - 1
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check the delays and the losses."""
        if self.delay != sorted(self.delay):
            yield f"{key}.delay", f"must not end before it begins, not {self.delay}"
        longest = _MOST_SAMPLES * scenario.sample_time
        if max(self.delay, default=0.0) > longest:
            problem = f"must be at most {longest:g} s ({_MOST_SAMPLES} control samples)"
            yield f"{key}.delay", f"{problem}, not {max(self.delay):g} s"
        least = self.drop_rate / (1.0 - self.drop_rate)
        if self.mean_burst is not None and self.mean_burst < least:
            problem = f"must be at least drop_rate / (1 - drop_rate) = {least:.4g} packets"
            yield f"{key}.mean_burst", f"{problem}, not {self.mean_burst:g}"
        if self.period is not None and (self.duration is None or self.duration >= self.period):
            yield f"{key}.period", f"must exceed a duration; set {key}.duration below it"


@dataclass
class Link(PacketLosses):
    """Link from the controller to the actuators, with a packet of forces for each control sample.

    The packets can be lost or late.
    """

    without: str = setting(
        "hold",
        "",
        'force in a sample without a new packet; "hold": of the last packet; "zero": none',
        one_of=("hold", "zero"),
    )
    hold_time: float | None = setting(
        None,
        "s",
        "time without a new packet after which a held force is zero; null: never",
        above=0,
    )
    coordinates: list[str] = setting(
        ["all"], "", "coordinates or groups whose forces are sent; others act as commanded"
    )
    reported: bool = setting(
        True,
        "",
        "true: the controller reads the applied force; false: it assumes that its command was "
        "applied",
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check the delays, the losses, and for actuators of the scenario."""
        yield from super().check(key, scenario)
        if self.hold_time is not None and self.without != "hold":
            yield f"{key}.hold_time", "has no effect without a held force; set without: hold"
        if scenario.blocks.actuation is not None:
            yield key, "has no effect on a block in place of the actuators; remove blocks.actuation"
        if scenario.faults is not None and not self.reported:
            yield f"{key}.reported", "must be true with faults, which change the reported force"


@dataclass
class SensorLink(PacketLosses):
    """Link from the sensors to the controller, with a packet of measurements for each control
    sample.

    The packets can be lost or late. Without a new packet, the controller reads the last one.
    """

    coordinates: list[str] = setting(
        ["all"],
        "",
        "coordinates or groups whose positions and velocities are sent; others are read at once",
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check the delays, the losses, and for detection, which predicts without a link."""
        yield from super().check(key, scenario)
        if getattr(scenario.faults, "detection", None) is not None:
            yield key, "cannot be combined with faults.detection, which assumes no link"
