"""What a physics engine needs to know of a robot beside its dimensions: the `[physics]` table of its file."""

from dataclasses import dataclass

from travjax.config import require, require_number


@dataclass(frozen=True)
class PhysicsConfig:
    """Mass, drive and tyres of a robot; kg, metres, seconds, newton metres.

    mass:           of robot and wheels, without payload
    payload:        mass on top of it
    centre_height:  height of the centre of mass above flat ground, with payload
    drive_torque:   largest torque on the wheels of a side together
    drive_inertia:  of a wheel with its share of motor and gears, as the wheel feels it, kg m^2
    coupled:        whether the wheels of a side turn together (chain, belt or gears)
    friction:       of the tyres on the ground
    speed:          at which trajectories are driven
    stiffness_time, stiffness_damping: time constant in seconds and damping ratio of a tyre's contact (MuJoCo's solref)
    impedance:      smallest and largest impedance of a tyre's contact, its width in metres, midpoint and power (solimp)

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    mass: float
    centre_height: float
    drive_torque: float
    drive_inertia: float
    payload: float = 0.0
    coupled: bool = True
    friction: float = 1.0
    speed: float = 0.5
    stiffness_time: float = 0.05
    stiffness_damping: float = 0.5
    impedance: tuple[float, float, float, float, float] = (0.3, 0.3, 0.001, 0.5, 2.0)

    def __post_init__(self):
        ranges = {
            "mass": (0.1, 1e5),
            "centre_height": (0.001, 10),
            "drive_torque": (0.01, 1e6),
            "drive_inertia": (1e-6, 1e4),
            "payload": (-1e-9, 1e5),
            "friction": (0.05, 5),
            "speed": (0.05, 5),
            "stiffness_time": (0.008, 1),
            "stiffness_damping": (0.1, 10),
        }
        for name, (low, high) in ranges.items():
            require_number(name, getattr(self, name), low, high, f"a number from {low:g} to {high:g}")
        require(isinstance(self.coupled, bool), "coupled", self.coupled, "true or false")
        numbers = isinstance(self.impedance, tuple) and len(self.impedance) == 5
        require(numbers, "impedance", self.impedance, "five numbers, as MuJoCo's solimp")
