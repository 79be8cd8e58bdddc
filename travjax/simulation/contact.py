"""Contact models: how wheels and body of a robot touch the ground (SPEC section 15)."""

from dataclasses import dataclass

from travjax.config import require

CONTACTS = ("nearest", "tyre")
"""The paper's model (nearest.py), and that of a robot that is to drive (tyre.py)."""


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
