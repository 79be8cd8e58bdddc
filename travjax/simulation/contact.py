"""Contact models: how wheels and body of a robot touch the ground (SPEC section 15)."""

from dataclasses import dataclass

from travjax.config import require

CONTACTS = ("nearest", "tyre")
"""The paper's model (nearest.py), and that of a robot that is to drive (tyre.py)."""


FINE = 0.0625
"""Metres between nodes above which a line says what that costs."""

COST_OF_SPACING = {
    "nearest": "wheels go by the nearest node, so rough ground counts as steps more often: on a Mars yard 5.9 % of the "
    "trajectories fail by step at 0.0625 m, 12.1 % at 0.1 m and 19.4 % at 0.125 m",
    "tyre": "what is narrower than two nodes is not seen, and rough ground counts as steps a little more often: on a "
    "Mars yard 6.8 % of the trajectories fail by step at 0.0625 m, 8.9 % at 0.1 m and 10.2 % at 0.125 m",
}
"""What nodes further apart than FINE cost, measured; BUILD_NOTES.md has the figures."""


def spacing_note(model: str, spacing: float) -> str | None:
    """Returns a line on what nodes so many metres apart cost by a contact model; None where they are close enough."""
    if spacing <= FINE + 1e-9:
        return None
    return f"nodes {spacing:g} m apart, more than {FINE:g} m: {COST_OF_SPACING[model]}"


@dataclass(frozen=True)
class Contact:
    """A contact model and what it counts.

    model: "nearest" or "tyre"
    turn:  whether the point turn at the start of a trajectory is simulated, which `nearest` never does

    Raises InputError (a ValueError) that names field, value and what is allowed.
    """

    model: str = "nearest"
    turn: bool = False

    def __post_init__(self):
        require_contact(self.model)
        require(isinstance(self.turn, bool), "turn", self.turn, "true or false")
        require(self.model != "nearest" or not self.turn, "turn", self.turn, 'false for the contact model "nearest"')

    @staticmethod
    def from_model(model: str, turn: bool = True) -> "Contact":
        """Returns a contact model with its point turns, if it has any; turn=False leaves them out."""
        require(isinstance(turn, bool), "turn", turn, "true or false")
        return Contact(model, turn and model != "nearest")


def require_contact(model: object) -> None:
    """Raises InputError unless it is the name of a contact model."""
    require(
        isinstance(model, str) and model in CONTACTS, "contact", model, " or ".join(f'"{name}"' for name in CONTACTS)
    )
