"""A trained estimator as one file: it comes back bit for bit, and what is no such file is said in one line."""

import json
import random
import struct

import jax
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save, save_file

from tests import small_training
from tests.field_runs import RUN, estimator
from tests.small_training import host, require_equal, run_of
from travjax.config import InputError
from travjax.models.variables import merge_model, split_model
from travjax.resnet.weight_files import open_arrays, write_safetensors
from travjax.runs.model_file import read_model, write_model
from travjax.runs.predictor import DEFAULT, WEIGHTS

NOTES = {"dataset": "0123", "epoch": 2, "step": 10, "score": 0.25}


@pytest.fixture
def file(tmp_path):
    """A tiny hazard field."""
    write_model(tmp_path / "field.safetensors", RUN, estimator(), NOTES)
    return tmp_path / "field.safetensors"


def metadata(file) -> dict:
    with safe_open(file, framework="np") as opened:
        return opened.metadata()


def rewritten(file, change=lambda arrays: arrays, described=None):
    """The file with other arrays, or another description."""
    arrays, notes = change(load_file(file)), metadata(file) if described is None else described
    file.write_bytes(save(arrays, metadata=notes))
    return file


def refusal(file) -> str:
    with pytest.raises(InputError) as raised:
        read_model(file)
    assert "\n" not in str(raised.value) and str(raised.value).startswith(f"{file}: ")
    return str(raised.value).removeprefix(f"{file}: ")


# ---- There and back


def test_a_hazard_field_comes_back_bit_for_bit(file):
    run, network, notes = read_model(file)
    assert (run, notes) == (RUN, NOTES)
    require_equal(host(split_model(network)[1]), host(split_model(estimator())[1]))
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(split_model(network)[1]))


def test_a_resnet_comes_back_bit_for_bit(tmp_path):
    path, made = tmp_path / "resnet.safetensors", small_training.estimator()
    write_model(path, run_of(), made, {})
    run, network, notes = read_model(path)
    assert (run, notes) == (run_of(), {})
    require_equal(host(split_model(network)[1]), host(split_model(made)[1]))


def test_the_same_estimator_gives_the_same_file_and_another_another(file, tmp_path):
    for seed, same in ((0, True), (1, False)):
        write_model(tmp_path / "again.safetensors", RUN, estimator(seed), NOTES)
        assert ((tmp_path / "again.safetensors").read_bytes() == file.read_bytes()) is same


def test_arrays_are_named_by_their_place(file):
    arrays = load_file(file)
    assert any(name.endswith("stem/kernel") for name in arrays)
    assert {name.split("/")[0] for name in arrays} == {"trunk", "heads", "statistics"}
    assert sum(array.size for array in arrays.values()) == sum(
        leaf.size for leaf in jax.tree.leaves(split_model(estimator())[1])
    )


# ---- What is no such file


def test_a_missing_file_is_named(tmp_path):
    assert refusal(tmp_path / "none.safetensors") == "no such file"


def test_a_folder_is_no_file(tmp_path):
    (tmp_path / "folder.safetensors").mkdir()
    assert refusal(tmp_path / "folder.safetensors").startswith("is a folder; allowed: a file")


@pytest.mark.parametrize("left", [0, 5, 200, -1])
def test_a_file_that_was_cut_off_is_refused(file, left):
    file.write_bytes(file.read_bytes()[:left])
    assert ("damaged" if left else "is empty") in refusal(file)


def test_arrays_of_something_else_are_refused(tmp_path):
    save_file({"x": np.zeros(3, np.float32)}, tmp_path / "x.safetensors")
    assert refusal(tmp_path / "x.safetensors") == ("holds no estimator of travjax; allowed: a file of `travjax export`")


@pytest.mark.parametrize(
    "described",
    [
        {},
        {"run": 3, "notes": {}},
        {"run": {}, "notes": {}},
        {"run": RUN.to_json()},
        {"run": RUN.to_json() | {"preset": 3}, "notes": {}},
        {"run": RUN.to_json() | {"actions": None}, "notes": {}},
        {"run": RUN.to_json() | {"robot": {"name": "x"}}, "notes": {}},
        [1, 2],
    ],
)
def test_a_file_that_does_not_say_what_it_was_made_from_is_refused(file, described):
    rewritten(file, described={"travjax": json.dumps(described)})
    assert refusal(file)


def changed(name: str, change):
    """A change of the first array whose name ends so."""

    def of(arrays):
        found = next(key for key in sorted(arrays) if key.endswith(name))
        return arrays | {found: change(arrays[found])}

    return of


def described(file) -> dict:
    """What the file says of itself, without its checksums: as older versions wrote it."""
    notes = json.loads(metadata(file)["travjax"])
    return {"travjax": json.dumps({name: notes[name] for name in ("run", "notes")})}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (changed("kernel", lambda array: array[..., :-1].copy()), "kernel"),
        (changed("bias", lambda array: array.astype(np.float64)), "bias"),
        (lambda arrays: dict(sorted(arrays.items())[1:]), "heads/"),
        (lambda arrays: arrays | {"more": np.zeros(1, np.float32)}, "more"),
    ],
)
def test_arrays_that_are_not_its_own_are_named(file, change, named):
    said = refusal(rewritten(file, change, described(file)))
    assert named in said.split(": not the arrays of its estimator; ")[0] and said.endswith("allowed: an undamaged file")


def test_arrays_of_another_estimator_are_named(tmp_path):
    path = tmp_path / "odd.safetensors"
    write_safetensors(path, {"heads/bias": np.zeros(3, np.float32)}, {"run": RUN.to_json(), "notes": {}})
    assert refusal(path).startswith("heads/bias, ")


# ---- Damage


def test_no_bit_that_turned_over_gives_another_estimator(file):
    """200 of them: a file is refused, or it is what it was but for the key of its checksums, which is said."""
    whole, wanted = file.read_bytes(), host(split_model(estimator())[1])
    length = struct.unpack("<Q", whole[:8])[0] + 8
    chosen, refused = random.Random(0), 0
    for number in range(200):
        damaged = bytearray(whole)
        damaged[chosen.randrange(length if number % 2 else len(whole))] ^= 1 << chosen.randrange(8)
        file.write_bytes(damaged)
        try:
            run, network, notes = read_model(file)
        except InputError as error:
            assert "\n" not in str(error)
            refused += 1
        else:  # 1e-05 and 1E-05 are the same number
            assert (run, notes) == (RUN, NOTES)
            require_equal(host(split_model(network)[1]), wanted)
    assert refused >= 195


def test_a_damaged_array_is_named(file):
    content = bytearray(file.read_bytes())
    name, told = sorted(load_header(content).items())[0]
    content[8 + struct.unpack("<Q", content[:8])[0] + told["data_offsets"][0]] ^= 1
    file.write_bytes(content)
    assert refusal(file) == f"the SHA-256 of {name} is not the one that the file gives: the file is damaged"


def load_header(content: bytes) -> dict:
    length = struct.unpack("<Q", content[:8])[0]
    return {name: told for name, told in json.loads(content[8 : 8 + length]).items() if name != "__metadata__"}


@pytest.mark.parametrize("setting", [("preset", "elevation_scale"), ("preset", "field", "epsilon"), ("robot", "track")])
def test_an_altered_setting_is_refused(file, setting):
    """Each of them would give other predictions."""
    told = json.loads(metadata(file)["travjax"])
    *places, last = setting
    table = told["run"]
    for place in places:
        table = table[place]
    table[last] *= 1.01
    rewritten(file, described={"travjax": json.dumps(told)})
    assert refusal(file).startswith("the SHA-256 of the description is not the one that ")


def test_a_file_without_checksums_is_read_and_said_to_have_none(file, capsys):
    read_model(file)
    assert capsys.readouterr().out == ""
    rewritten(file, described=described(file))
    run, network, notes = read_model(file)
    assert (run, notes) == (RUN, NOTES)
    require_equal(host(split_model(network)[1]), host(split_model(estimator())[1]))
    said = capsys.readouterr().out
    assert said.startswith(f"{file}: has no checksums, ") and said.count("\n") == 1


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_none_are_neither_read_nor_written(file, tmp_path, value):
    def spoilt(array):
        array = array.copy()
        array[-1] = value
        return array

    graph, variables = split_model(estimator())
    broken = merge_model(
        graph, jax.tree.map(lambda leaf: spoilt(np.array(leaf)) if leaf.ndim == 1 else leaf, variables)
    )
    with pytest.raises(InputError, match=rf"new.safetensors: .* = {value}: must be finite throughout"):
        write_model(tmp_path / "new.safetensors", RUN, broken, NOTES)
    assert not (tmp_path / "new.safetensors").exists()
    rewritten(file, changed("hazard/bias", spoilt), described(file))
    assert refusal(file) == (
        f"heads/heads/hazard/bias = {value}: must be finite throughout, as the weights of a network are"
    )


def test_what_was_not_written_by_travjax_is_refused(file):
    told = json.loads(described(file)["travjax"]) | {"sha257": {}}
    rewritten(file, described={"travjax": json.dumps(told)})
    assert refusal(file).startswith("holds no estimator of travjax")


def test_a_file_of_old_keys_is_read_with_one_notice(file, capsys):
    text = json.dumps({"run": RUN.to_json(), "notes": NOTES})
    for new, old in (("trajectories_per_map", "each"), ("optimizer", "method"), ("probability", "share")):
        text = text.replace(f'"{new}": ', f'"{old}": ')
    write_safetensors(file, load_file(file), json.loads(text))
    run, network, notes = read_model(file)
    assert (run, notes) == (RUN, NOTES)
    require_equal(host(split_model(network)[1]), host(split_model(estimator())[1]))
    assert capsys.readouterr().out == (
        f"{file}: keys 'share', 'method', 'each' are now called 'probability', 'optimizer', 'trajectories_per_map'; "
        "the old names will not be read by the next version\n"
    )


def test_the_estimator_that_comes_with_the_package_has_checksums_and_no_old_keys(capsys):
    with open_arrays(WEIGHTS / f"{DEFAULT}.safetensors") as shipped:
        assert shipped.checked
    read_model(WEIGHTS / f"{DEFAULT}.safetensors")
    assert capsys.readouterr().out == ""
