"""Describes a robot of your own, and asks what more ground clearance would be worth.

    python examples/own_robot.py

It writes runs/examples/my_rover.toml, which every command takes (`travjax label site.tif --robot FILE`), and prints

    clearance 0.08 m: 34.4 % of the trajectories fail
    clearance 0.12 m: 31.0 % of the trajectories fail
    clearance 0.16 m: 27.7 % of the trajectories fail
    clearance 0.20 m: 25.5 % of the trajectories fail
    clearance 0.24 m: 24.2 % of the trajectories fail
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

import travjax

MY_ROVER = """
name = "My rover"
wheelbase = 0.50         # metres, as all lengths
track = 0.62
wheel_diameter = 0.30
wheel_width = 0.12
chassis_length = 0.80
chassis_width = 0.46
overall_length = 0.85
overall_width = 0.74
ride_height = 0.12       # limit of the obstacle margin
max_step = 0.10          # limit of the step margin
max_tilt_deg = 30        # limit of the tilt margin
"""


def main(maps: int = 32) -> None:
    """Prints the share of failing trajectories for several clearances."""
    path = Path("runs/examples/my_rover.toml")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(MY_ROVER)
    robot = travjax.Robot.load(path)

    heights = travjax.generate_terrain("scattered_sharp", range(maps))
    margins = travjax.simulate(heights, robot)  # once: margins do not depend on the limits
    for clearance in (0.08, 0.12, 0.16, 0.20, 0.24):
        failed = np.asarray(travjax.failures(margins, replace(robot, ride_height=clearance)))
        print(f"clearance {clearance:.2f} m: {100 * failed.any(axis=-1).mean():4.1f} % of the trajectories fail")


if __name__ == "__main__":
    main()
