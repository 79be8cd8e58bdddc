"""Four-wheel skid-steer robots (SPEC section 3); presets are the TOML files in robots/."""

import math
from dataclasses import dataclass, field, fields
from pathlib import Path

from travjax.config import InputError, load_toml, require, require_number

PRESETS = Path(__file__).parent / "robots"


@dataclass(frozen=True)
class Robot:
    """Dimensions and limits of a robot; metres and radians.

    wheelbase:      front to rear wheel centres
    track:          left to right wheel centres
    wheel_diameter, wheel_width
    chassis_length, chassis_width: the body that can hit the ground, centred on the wheels
    overall_length, overall_width: outer dimensions, for pictures
    ride_height:    ground clearance under the chassis: the limit of the obstacle margin
    max_step:       limit of the step margin
    max_tilt:       limit of the tilt margin, radians

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    name: str
    wheelbase: float
    track: float
    wheel_diameter: float
    wheel_width: float
    chassis_length: float
    chassis_width: float
    overall_length: float
    overall_width: float
    ride_height: float
    max_step: float
    max_tilt: float = field(metadata={"angle": True})

    def __post_init__(self):
        require(isinstance(self.name, str) and bool(self.name), "name", self.name, "a non-empty text")
        for one in fields(self):
            if one.name not in ("name", "max_tilt"):
                require_number(one.name, getattr(self, one.name), 0, 100, "a length in metres, above 0 and at most 100")
        require_number("max_tilt", self.max_tilt, 0, math.pi / 2, "an angle above 0 and at most 90 degrees (pi/2 rad)")

    @staticmethod
    def load(source: "str | Path | Robot") -> "Robot":
        """A preset by name ("seekur_jr"), or a TOML file by path.

        Raises InputError when there is no such preset or file, or when the file is wrong.
        """
        if isinstance(source, Robot):
            return source
        if Path(source).suffix == ".toml":
            return load_toml(source, Robot)
        if str(source) not in Robot.presets():
            raise InputError(
                f"robot {str(source)!r}: no such preset; allowed: {', '.join(Robot.presets())}, or a .toml file"
            )
        return load_toml(PRESETS / f"{source}.toml", Robot)

    @staticmethod
    def presets() -> list[str]:
        """Names of the robots that come with the package."""
        return sorted(path.stem for path in PRESETS.glob("*.toml"))

    @property
    def limits(self) -> tuple[float, float, float]:
        """Largest allowed (step [m], obstacle [m], tilt [rad])."""
        return self.max_step, self.ride_height, self.max_tilt

    def wheel_positions(self) -> tuple[tuple[float, float], ...]:
        """(right, forward) of the wheels FL, FR, RL, RR, metres."""
        right, forward = self.track / 2, self.wheelbase / 2
        return (-right, forward), (right, forward), (-right, -forward), (right, -forward)
