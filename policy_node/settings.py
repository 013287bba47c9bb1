"""How a policy is trained, whatever it observes: every default of training stands here."""

from __future__ import annotations

from dataclasses import dataclass

from curation_ros.core.errors import PolicyError


@dataclass(frozen=True)
class TrainingSettings:
    """Numbers of a training, apart from demonstrations, variant and seed.

    Attributes:
        steps: gradient steps of Adam. Steps are fixed, not epochs: a larger selection is not
            trained for longer.
        batch_size: rows per step, drawn with replacement from all steps of all demonstrations.
        lr: learning rate.
        weight_decay: L2 penalty, as `torch.optim.Adam` has it.
        hidden: widths of the hidden layers, ReLU. The output is a tanh.
        std_floor: least standard deviation to divide an observation by, in m and rad; converted
            for cm, mm and deg, taken as it is for other units. A table's height hardly varies, and
            must not be blown up.
        start_jitter_m: standard deviation of the noise on the lengths of an observation that are
            held from the start, m; drawn anew for each row of a batch, 0 for none. The exact start
            is a fingerprint of its episode: without noise the network learns by heart how fast and
            how slanted each episode went, and strays from its path on starts that are new.

    Raises:
        PolicyError: if a number is out of range.
    """

    steps: int = 4000
    batch_size: int = 256
    lr: float = 1e-3
    weight_decay: float = 1e-4
    hidden: tuple[int, ...] = (256, 256)
    std_floor: float = 2e-3
    start_jitter_m: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (
            ("steps", self.steps),
            ("batch_size", self.batch_size),
            ("hidden", min(self.hidden, default=0)),
        ):
            if value < 1:
                raise PolicyError(f"training: {name} is {value}, expected at least 1")
        for name, number in (("lr", self.lr), ("std_floor", self.std_floor)):
            if not number > 0.0:
                raise PolicyError(f"training: {name} is {number}, expected more than 0")
        at_least_zero = {"weight_decay": self.weight_decay, "start_jitter_m": self.start_jitter_m}
        for name, number in at_least_zero.items():
            if not number >= 0:
                raise PolicyError(f"training: {name} is {number}, expected 0 or more")


DEFAULTS = TrainingSettings()
"""What is trained with where nothing else is said."""
