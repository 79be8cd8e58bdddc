"""Contact models: their names, and what nodes that are far apart cost."""

import pytest

from travjax.config import InputError
from travjax.simulation.contact import CONTACTS, COST_OF_SPACING, Contact, spacing_note


@pytest.mark.parametrize("model", CONTACTS)
def test_coarse_nodes_have_a_line(model):
    assert spacing_note(model, 0.0625) is None and spacing_note(model, 0.04) is None
    assert spacing_note(model, 0.125) == f"nodes 0.125 m apart, more than 0.0625 m: {COST_OF_SPACING[model]}"


def test_a_model_is_named_and_nearest_has_no_turns():
    assert Contact.from_model("tyre").turn and not Contact.from_model("nearest").turn
    with pytest.raises(InputError, match='contact = \'soft\': must be "nearest" or "tyre"'):
        Contact.from_model("soft")
    with pytest.raises(InputError, match="turn = True: must be false"):
        Contact("nearest", True)
