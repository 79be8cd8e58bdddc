"""Four-wheel skid-steer robots (SPEC section 3); presets are the TOML files in robots/."""

import math
from dataclasses import dataclass, field, fields
from pathlib import Path

from travjax.config import InputError, load_table, load_toml, require, require_length, require_number
from travjax.simulation.contact import require_contact
from travjax.simulation.events import OPTIONAL, PAPER, Event
from travjax.simulation.physics_table import PhysicsConfig

PRESETS = Path(__file__).parent / "robots"

OTHER_TABLES = {"physics": PhysicsConfig}
"""Tables of a robot's file that are no part of a Robot: labels do not depend on them."""

LONGEST_NAME = 100
"""Characters that a robot's name may have at most."""


@dataclass(frozen=True)
class Robot:
    """Dimensions and limits of a robot; metres and radians, lengths from a millimetre to 100 m.

    name:           what tables and figures call it, in one line
    wheelbase:      front to rear wheel centres
    track:          left to right wheel centres; the wheels must not be inside the chassis
    wheel_diameter, wheel_width
    chassis_length, chassis_width: the body that can hit the ground, centred between the wheels
    overall_length, overall_width: outer dimensions: the outline of the contact model `tyre`, and for pictures
    ride_height:    ground clearance under the chassis: the limit of the obstacle margin
    max_step:       limit of the step margin
    max_tilt:       limit of the tilt margin, radians
    max_roll:       limit of the roll margin, the largest sideways slope of the pose plane as an angle, radians. Without
                    it, as in the paper, a robot has no roll event; with it, roll is a fourth event of labels, tables,
                    figures and estimators
    overhang_height: ground clearance under what lies beyond the chassis in the overall outline; the ride height unless
                    given. This and the next are for the contact model `tyre` (SPEC section 15)
    nose_rise:      how much higher than at the axles the underside is, or gives way, at the front and rear ends; none
                    unless given
    contact:        contact model of this robot, "nearest" or "tyre", where no command or argument says otherwise

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
    max_roll: float | None = field(default=None, metadata={"angle": True, "optional": True})
    overhang_height: float | None = field(default=None, metadata={"optional": True})
    nose_rise: float | None = field(default=None, metadata={"optional": True})
    contact: str | None = field(default=None, compare=False, metadata={"optional": True})

    def __post_init__(self):
        named = isinstance(self.name, str) and 0 < len(self.name) <= LONGEST_NAME and self.name.isprintable()
        require(named, "name", self.name, f"a non-empty text of one line, at most {LONGEST_NAME} characters")
        if self.contact is not None:
            require_contact(self.contact)
        for one in fields(self)[1:]:
            value = getattr(self, one.name)
            if one.name == "contact" or (value is None and "optional" in one.metadata):
                continue
            if "angle" in one.metadata:
                allowed = "an angle from 0.01 to 90 degrees (pi/2 rad)"
                require_number(one.name, value, math.radians(0.0099), math.pi / 2, allowed)
            else:
                require_length(one.name, value, 0.001, 100)
        self._require_wheels_outside()

    def _require_wheels_outside(self) -> None:
        """Raises InputError when the wheels would overlap the chassis in width, length and height."""
        least = self.chassis_width + self.wheel_width
        along = self.wheelbase - self.wheel_diameter < self.chassis_length
        inside = self.track < least - 1e-9 and along and self.ride_height < self.wheel_diameter
        allowed = f"at least chassis_width + wheel_width = {self.chassis_width:g} + {self.wheel_width:g} = {least:g} m"
        require(not inside, "track", self.track, f"{allowed}, or the wheels are inside the chassis")

    @staticmethod
    def load(source: "str | Path | Robot") -> "Robot":
        """Loads a preset by name ("seekur_jr"), or a TOML file by path.

        Raises InputError when there is no such preset or file, or when the file is wrong.
        """
        if isinstance(source, Robot):
            return source
        return load_toml(Robot.path_of(source), Robot, OTHER_TABLES)

    @staticmethod
    def load_physics(source: str | Path) -> PhysicsConfig:
        """Reads the `[physics]` table of a preset by name, or of a TOML file by path.

        Raises InputError as `load` does, and when the file has no such table, or when that is wrong.
        """
        path = Robot.path_of(source)
        Robot.load(path)
        found = load_table(path, "physics", PhysicsConfig)
        if found is None:
            needed = "mass, centre_height, drive_torque and drive_inertia"
            raise InputError(f"{path}: no table [physics]; needed: one with at least {needed} (see docs/physics.md)")
        return found

    @staticmethod
    def path_of(source: str | Path) -> Path:
        """Returns the TOML file of a preset by name, or of a path itself; raises InputError for neither."""
        if Path(source).suffix.lower() == ".toml":
            return Path(source)
        if str(source) not in Robot.presets():
            raise InputError(
                f"robot {str(source)!r}: no such preset; allowed: {', '.join(Robot.presets())}, or a .toml file"
            )
        return PRESETS / f"{source}.toml"

    @staticmethod
    def presets() -> list[str]:
        """Returns the names of the robots that come with the package."""
        return sorted(path.stem for path in PRESETS.glob("*.toml"))

    @property
    def events(self) -> tuple[Event, ...]:
        """The failure events that this robot has limits for; step, obstacle and tilt come first."""
        return PAPER + tuple(event for event in OPTIONAL if getattr(self, event.limit) is not None)

    @property
    def event_names(self) -> tuple[str, ...]:
        """The names of the robot's events in labels, tables and figures."""
        return tuple(event.name for event in self.events)

    @property
    def limits(self) -> tuple[float, ...]:
        """The largest allowed margin of each event: step [m], obstacle [m], tilt [rad]."""
        return tuple(getattr(self, event.limit) for event in self.events)

    def wheel_positions(self) -> tuple[tuple[float, float], ...]:
        """Returns the positions (right, forward) of the wheels FL, FR, RL, RR in metres."""
        right, forward = self.track / 2, self.wheelbase / 2
        return (-right, forward), (right, forward), (-right, -forward), (right, -forward)
