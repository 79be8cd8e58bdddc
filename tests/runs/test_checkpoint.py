"""Checkpoints come back bit for bit, survive kills, damage and full disks, and say in one line what is wrong."""

import asyncio
import errno
import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from travjax.config import InputError
from travjax.runs import checkpoint
from travjax.runs.checkpoint import Checkpoints, load_meta
from travjax.runs.quiet_orbax import patient_loops


def state_of(number: int) -> dict:
    """A small state of every dtype that training saves; another number gives another one."""
    kernel = jax.random.normal(jax.random.key(number), (3, 4))
    parameters = {"trunk": {"conv1.kernel": kernel, "half": kernel.astype(jnp.bfloat16)}, "heads": [kernel[0]]}
    optimiser = optax.rmsprop(optax.exponential_decay(1e-3, 10, 0.5), momentum=0.9).init(parameters)
    optimiser = jax.tree.map(lambda x: x + jnp.asarray(number, x.dtype), optimiser)
    return {"parameters": parameters, "optimiser": optimiser, "key": jnp.array([7, number], jnp.uint32)}


def meta_of(number: int) -> dict:
    return {"step": number, "phase": "heads", "loss": [0.1 * number, 1e-300], "radii": {"a": float("inf")}}


def require_equal(actual, expected) -> None:
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for (path, one), other in zip(jax.tree_util.tree_leaves_with_path(actual), jax.tree.leaves(expected), strict=True):
        assert one.dtype == other.dtype, path
        assert one.shape == other.shape, path
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes(), path


def listing(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def saved(folder: Path, *steps: int, best: tuple[int, ...] = (), keep_latest: int = 2) -> Checkpoints:
    checkpoints = Checkpoints(folder, keep_latest)
    for step in steps:
        checkpoints.save(step, state_of(step), meta_of(step), best=step in best)
    return checkpoints


def one_line(raised: pytest.ExceptionInfo) -> str:
    message = str(raised.value)
    assert len(message.splitlines()) == 1
    return message


def run(script: str, *arguments, **options) -> subprocess.Popen:
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": os.pathsep.join(sys.path)}
    environment["JAX_ENABLE_COMPILATION_CACHE"] = "false"  # XLA says things when it reads it
    command = [sys.executable, "-W", "error", "-c", textwrap.dedent(script), *map(str, arguments)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True, **options)


# Round trip


def test_a_state_comes_back_bit_for_bit(tmp_path):
    state = state_of(3)
    Checkpoints(tmp_path).save(3, state, meta_of(3))
    checkpoints = Checkpoints(tmp_path)
    template = jax.tree.map(jnp.zeros_like, state)
    restored, meta = checkpoints.restore(template)
    require_equal(restored, state)
    assert {leaf.dtype.name for leaf in jax.tree.leaves(restored)} == {"float32", "bfloat16", "uint32", "int32"}
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(restored))
    assert meta == meta_of(3)
    assert checkpoints.notices == []


def test_special_values_keep_their_bits(tmp_path):
    bits = np.array([0x7FC00001, 0xFF800000, 0x00000001, 0x80000000], np.uint32)
    Checkpoints(tmp_path).save(0, {"x": jnp.asarray(bits.view(np.float32))}, {})
    restored, _ = Checkpoints(tmp_path).restore()
    np.testing.assert_array_equal(restored["x"].view(np.uint32), bits)


def test_without_a_template_it_comes_back_as_nested_dicts_of_numpy_arrays(tmp_path):
    state = state_of(3)
    restored, _ = saved(tmp_path, 3).restore()
    assert all(type(leaf) is np.ndarray for leaf in jax.tree.leaves(restored))
    assert set(restored) == {"parameters", "optimiser", "key"}
    require_equal(restored["parameters"]["trunk"], state["parameters"]["trunk"])
    require_equal(restored["parameters"]["heads"]["0"], state["parameters"]["heads"][0])
    require_equal(restored["optimiser"]["0"]["nu"]["trunk"], state["optimiser"][0].nu["trunk"])


def test_shardings_are_those_of_the_template(tmp_path):
    state = {"x": jnp.arange(8.0)}
    Checkpoints(tmp_path).save(0, state, {})
    mesh = jax.make_mesh((len(jax.devices()),), ("data",))
    sharding = jax.NamedSharding(mesh, jax.P())
    shapes = jax.eval_shape(lambda: state)
    sharded = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), shapes)
    assert Checkpoints(tmp_path).restore(sharded)[0]["x"].sharding == sharding
    assert type(Checkpoints(tmp_path).restore(shapes)[0]["x"]) is np.ndarray


def test_the_checksums_are_those_of_sha256sum(tmp_path):
    saved(tmp_path, 1)
    (path,) = tmp_path.iterdir()
    subprocess.run(["sha256sum", "--strict", "-c", "SHA256SUMS"], cwd=path, check=True, capture_output=True)


@pytest.mark.parametrize("meta", [{"a": np.float32(1)}, {"a": {1, 2}}])
def test_what_json_cannot_hold_is_refused_before_anything_is_written(tmp_path, meta):
    with pytest.raises(TypeError, match="JSON"):
        Checkpoints(tmp_path / "run").save(0, state_of(0), meta)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("leaf", [1.5, "text", jax.random.key(0), jnp.zeros((0, 3))])
def test_what_is_no_array_of_numbers_is_refused_before_anything_is_written(tmp_path, leaf):
    with pytest.raises(InputError, match="^heads/0 = .*must be an array of numbers that is not empty"):
        Checkpoints(tmp_path / "run").save(0, {"heads": [leaf]}, {})
    assert not (tmp_path / "run").exists()


# Which are kept


def test_the_latest_few_and_the_best_are_kept(tmp_path):
    checkpoints = saved(tmp_path, 10, 20, 30, 40, 50, best=(10, 20))
    assert listing(tmp_path) == ["000002-step-20-best", "000004-step-40", "000005-step-50"]
    for which, step in {"latest": 50, "best": 20}.items():
        restored, meta = checkpoints.restore(state_of(0), which)
        require_equal(restored, state_of(step))
        assert meta == meta_of(step) == load_meta(tmp_path, which)


def test_the_best_may_be_among_the_latest(tmp_path):
    saved(tmp_path, 1, 2, 3, best=(1, 2, 3), keep_latest=1)
    assert listing(tmp_path) == ["000003-step-3-best"]


def test_named_checkpoints_stand_apart(tmp_path):
    checkpoints = saved(tmp_path, 10, best=(10,))
    checkpoints.save_named("heads", state_of(11), meta_of(11))
    checkpoints.save_named("before_fire", state_of(12), meta_of(12))
    checkpoints.save_named("heads", state_of(13), meta_of(13))
    assert load_meta(tmp_path) == load_meta(tmp_path, "best") == meta_of(10)
    for step in (20, 30, 40):
        checkpoints.save(step, state_of(step), meta_of(step))
    kept = ["000001-step-10-best", "000003-before_fire", "000004-heads", "000006-step-30", "000007-step-40"]
    assert listing(tmp_path) == kept
    restored, meta = checkpoints.restore(state_of(0), "heads")
    require_equal(restored, state_of(13))
    assert meta == meta_of(13)


def test_the_latest_is_the_one_saved_last_even_at_an_earlier_step(tmp_path):
    saved(tmp_path, 20, 30)
    saved(tmp_path, 10)
    assert load_meta(tmp_path) == meta_of(10)
    saved(tmp_path, 10)
    assert listing(tmp_path) == ["000003-step-10", "000004-step-10"]


def test_other_files_of_the_folder_are_left_alone(tmp_path):
    for name in ("step-1", "metrics.jsonl", "000001-Step-3", "12-step-3"):
        (tmp_path / name).mkdir()
    saved(tmp_path, 1, 2, 3)
    assert {"step-1", "metrics.jsonl", "000001-Step-3", "12-step-3"} < set(listing(tmp_path))


@pytest.mark.parametrize("name", ["latest", "best", "step-3", "", "Heads", "../heads", "a b"])
def test_names_that_would_confuse_are_refused(tmp_path, name):
    with pytest.raises(InputError, match=rf"^name = {re.escape(repr(name))}: must be lower-case"):
        Checkpoints(tmp_path).save_named(name, state_of(0), {})


@pytest.mark.parametrize("keep_latest", [0, -1, 1.5])
def test_at_least_one_is_kept(tmp_path, keep_latest):
    with pytest.raises(InputError, match="^keep_latest = .*: must be an integer from 1$"):
        Checkpoints(tmp_path, keep_latest)


# Damage


def largest_file(path: Path) -> Path:
    return max((file for file in path.rglob("*") if file.is_file()), key=lambda file: file.stat().st_size)


def truncate(path: Path) -> None:
    file = largest_file(path / "state")
    os.truncate(file, file.stat().st_size // 2)


def alter(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def remove_line(path: Path) -> None:
    sums = path / "SHA256SUMS"
    sums.write_text("".join(sums.read_text().splitlines(keepends=True)[1:]))


DAMAGES = {
    "truncated arrays": truncate,
    "emptied arrays": lambda path: os.truncate(largest_file(path / "state"), 0),
    "a flipped bit in the arrays": lambda path: alter(largest_file(path / "state")),
    "arrays missing": lambda path: largest_file(path / "state").unlink(),
    "a flipped bit in the meta": lambda path: alter(path / "meta.json"),
    "meta missing": lambda path: (path / "meta.json").unlink(),
    "a flipped bit in the checksums": lambda path: alter(path / "SHA256SUMS"),
    "checksums missing": lambda path: (path / "SHA256SUMS").unlink(),
    "checksums emptied": lambda path: os.truncate(path / "SHA256SUMS", 0),
    "a checksum missing": remove_line,
    "checksums that are no text": lambda path: (path / "SHA256SUMS").write_bytes(b"\xff\xfe"),
    "a file too many": lambda path: (path / "state" / "extra").touch(),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_passed_over_with_a_notice(tmp_path, damage):
    saved(tmp_path, 1, 2)
    DAMAGES[damage](tmp_path / "000002-step-2")
    checkpoints = Checkpoints(tmp_path)
    restored, meta = checkpoints.restore(state_of(0))
    require_equal(restored, state_of(1))
    assert meta == meta_of(1)
    notice, used = checkpoints.notices
    assert used == f"{tmp_path}/000001-step-1: is used instead"
    assert notice.startswith(f"{tmp_path}/000002-step-2: damaged checkpoint passed over: ")
    assert len(notice.splitlines()) == 1


def test_the_good_one_outlives_damaged_ones_once_training_goes_on(tmp_path):
    saved(tmp_path, 1, 2)
    alter(tmp_path / "000002-step-2" / "meta.json")
    checkpoints = Checkpoints(tmp_path)
    checkpoints.restore(state_of(0))
    checkpoints.save(2, state_of(2), meta_of(2))
    assert listing(tmp_path) == ["000001-step-1", "000003-step-2"]
    checkpoints.restore(state_of(0))
    assert checkpoints.notices == []


def test_the_latest_stands_in_for_a_damaged_best_one(tmp_path):
    checkpoints = saved(tmp_path, 1, 2, 3, best=(1,))
    alter(tmp_path / "000001-step-1-best" / "meta.json")
    assert checkpoints.restore(state_of(0), "best")[1] == meta_of(3) == load_meta(tmp_path, "best")
    assert "000001-step-1-best: damaged" in checkpoints.notices[0]


def test_no_good_checkpoint_names_folder_and_reasons(tmp_path):
    checkpoints = saved(tmp_path, 1, 2)
    alter(tmp_path / "000001-step-1" / "meta.json")
    (tmp_path / "000002-step-2" / "SHA256SUMS").unlink()
    with pytest.raises(InputError) as raised:
        checkpoints.restore(state_of(0))
    assert one_line(raised) == (
        f"{tmp_path}: holds no checkpoint 'latest' that is whole: 000002-step-2: SHA256SUMS cannot be read: "
        "No such file or directory; 000001-step-1: meta.json is altered or truncated"
    )
    assert len(checkpoints.notices) == 2


def test_another_format_version_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "FORMAT", 7)
    saved(tmp_path, 1)
    monkeypatch.undo()
    with pytest.raises(InputError, match="000001-step-1: format = 7: must be 1, "):
        load_meta(tmp_path)


# Templates of something else


def without_heads(state: dict) -> dict:
    return state | {"parameters": {"trunk": state["parameters"]["trunk"]}}


def with_wider_heads(state: dict) -> dict:
    return state | {"parameters": state["parameters"] | {"heads": [jnp.zeros(5)]}}


MISMATCHES = {
    "missing here": (lambda state: state | {"extra": {"bias": jnp.zeros(2)}}, "extra/bias is missing here and float32"),
    "missing there": (without_heads, "parameters/heads/0 is float32[4] here and missing there"),
    "another shape": (with_wider_heads, "parameters/heads/0 is float32[4] here and float32[5] there"),
    "another dtype": (lambda state: state | {"key": jnp.zeros(2, jnp.int32)}, "key is uint32[2] here and int32[2] "),
    "another optimiser": (lambda state: state | {"optimiser": optax.adam(1e-3).init(state["parameters"])}, "more"),
}


@pytest.mark.parametrize("mismatch", MISMATCHES)
def test_other_arrays_than_the_template_has_are_an_error(tmp_path, mismatch):
    change, expected = MISMATCHES[mismatch]
    checkpoints = saved(tmp_path, 1, 2)
    with pytest.raises(InputError) as raised:
        checkpoints.restore(change(state_of(0)))
    assert one_line(raised).startswith(f"{tmp_path}/000002-step-2: other arrays than the network and optimiser have: ")
    assert expected in str(raised.value)
    assert checkpoints.notices == []


# Folders that are none


def test_a_missing_folder_is_named(tmp_path):
    for attempt in (lambda: Checkpoints(tmp_path / "none").restore(), lambda: load_meta(tmp_path / "none")):
        with pytest.raises(InputError) as raised:
            attempt()
        assert one_line(raised).startswith(f"{tmp_path}/none: cannot be read: No such file or directory; allowed: ")


def test_a_folder_of_another_kind_is_named(tmp_path):
    (tmp_path / "dataset.json").touch()
    with pytest.raises(InputError) as raised:
        load_meta(tmp_path)
    assert one_line(raised) == f"{tmp_path}: holds no checkpoint 'latest'; it holds: none at all"


def test_a_checkpoint_that_is_not_there_is_named_beside_those_that_are(tmp_path):
    checkpoints = saved(tmp_path, 1)
    checkpoints.save_named("heads", state_of(1), {})
    with pytest.raises(InputError) as raised:
        checkpoints.restore(which="best")
    assert one_line(raised) == f"{tmp_path}: holds no checkpoint 'best'; it holds: heads, latest"


@pytest.mark.parametrize("folder", ["file", "file/sub"])
def test_a_folder_that_cannot_be_written_is_named(tmp_path, folder):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=f"^{tmp_path / folder}: checkpoint cannot be written: "):
        saved(tmp_path / folder, 1)
    assert (tmp_path / "file").read_text() == "mine"


# Writing that fails


@pytest.mark.parametrize("stage", ["write_text", "rename"])
def test_a_full_disk_leaves_the_earlier_checkpoints(tmp_path, monkeypatch, stage):
    checkpoints = saved(tmp_path, 1, best=(1,))

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, stage, full)
    with pytest.raises(InputError) as raised:
        checkpoints.save(2, state_of(2), meta_of(2), best=True)
    monkeypatch.undo()
    assert one_line(raised) == (
        f"{tmp_path}: checkpoint cannot be written: No space left on device; the earlier ones are kept"
    )
    assert listing(tmp_path) == ["000001-step-1-best"]
    require_equal(checkpoints.restore(state_of(0))[0], state_of(1))
    checkpoints.save(2, state_of(2), meta_of(2))
    assert load_meta(tmp_path) == meta_of(2)


def test_writes_that_are_under_way_when_one_fails_end_before_what_they_wrote_is_removed():
    # Orbax closes its event loop at once; the threads of the others then print tracebacks, and make folders again.
    ended = []

    async def write():
        await asyncio.sleep(0.05)
        await asyncio.to_thread(ended.append, "thread")
        ended.append("task")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    async def save():
        tasks.append(asyncio.create_task(write()))
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    tasks, before = [], asyncio.get_event_loop_policy()
    with patient_loops():
        loop = asyncio.new_event_loop()
        with pytest.raises(OSError):
            loop.run_until_complete(save())
        loop.close()
        loop.close()
    assert ended == ["thread", "task"] and isinstance(tasks[0].exception(), OSError)
    assert asyncio.get_event_loop_policy() is before


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_a_disk_without_room_is_found_before_arrays_are_written(tmp_path, monkeypatch, code):
    checkpoints = saved(tmp_path, 1)
    asked = []

    def full(number, start, size):
        asked.append(size)
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "posix_fallocate", full)
    monkeypatch.setattr(checkpoint, "quiet_orbax", None)  # not reached
    with pytest.raises(InputError) as raised:
        checkpoints.save(2, state_of(2), meta_of(2))
    assert one_line(raised) == (
        f"{tmp_path}: checkpoint cannot be written: {os.strerror(code)}; the earlier ones are kept"
    )
    assert asked[0] > sum(leaf.nbytes for leaf in jax.tree.leaves(state_of(2)))
    assert listing(tmp_path) == ["000001-step-1"]


def test_arrays_that_the_system_will_not_take_leave_the_earlier_checkpoints(tmp_path):
    # A limit on the size of files fails inside TensorStore, as a full disk does.
    checkpoints = saved(tmp_path, 1)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        with pytest.raises(InputError) as raised:
            checkpoints.save(2, {"x": jax.random.normal(jax.random.key(0), (100, 1000))}, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert one_line(raised).startswith(f"{tmp_path}: checkpoint cannot be written: File too large; ")
    assert listing(tmp_path) == ["000001-step-1"]
    require_equal(checkpoints.restore(state_of(0))[0], state_of(1))


KEEP_SAVING = """
    import os, signal, sys
    from pathlib import Path
    import jax.numpy as jnp
    from travjax.runs.checkpoint import Checkpoints

    folder, first, last_words = sys.argv[1], int(sys.argv[2]), sys.argv[3]
    checkpoints = Checkpoints(folder)
    rename = Path.rename
    def deadly(path, target):
        if last_words == "before renaming":
            os.kill(os.getpid(), signal.SIGKILL)
        result = rename(path, target)
        if last_words == "after renaming" or last_words == "while removing" and "unfinished" in str(target):
            os.kill(os.getpid(), signal.SIGKILL)
        return result
    for step in range(first, first + 1000):
        if step == first + 5 and last_words:
            Path.rename = deadly
        checkpoints.save(step, {"x": jnp.full((50, 1000), step), "y": jnp.float32(step)}, {"step": step}, step % 3 == 0)
        print(step, flush=True)
"""


def require_good_after_kill(folder: Path, last: int) -> None:
    """What was reported as saved is there, or the one in progress when the kill came."""
    checkpoints = Checkpoints(folder)
    restored, meta = checkpoints.restore()
    assert meta["step"] in (last, last + 1)
    assert (restored["x"] == meta["step"]).all()
    assert restored["y"] == meta["step"]
    best = checkpoints.restore(which="best")[1]["step"]
    assert best % 3 == 0
    assert meta["step"] - best < 3
    assert checkpoints.notices == []


def killed(child: subprocess.Popen, last: int = -1) -> int:
    """The last step that a killed child reported as saved, `last` if it said nothing since."""
    with child:  # no communicate(), which would lose what readline() has read ahead
        child.wait(timeout=60)
        output, errors = child.stdout.read(), child.stderr.read()
    assert child.returncode == -signal.SIGKILL, errors
    return int(output.split()[-1]) if output else last


def test_a_kill_at_any_moment_loses_no_checkpoint(tmp_path):
    folders = {moment: tmp_path / moment for moment in ("before renaming", "after renaming", "while removing")}
    children = {moment: run(KEEP_SAVING, folder, 0, moment) for moment, folder in folders.items()}
    last = {moment: killed(child) for moment, child in children.items()}
    for moment, folder in folders.items():
        require_good_after_kill(folder, last[moment])
        assert (checkpoint.UNFINISHED in listing(folder)) == (moment != "after renaming")

    for _ in range(2):  # at random moments of runs that go on where the last ones were killed
        children = {moment: run(KEEP_SAVING, folder, last[moment] + 2, "") for moment, folder in folders.items()}
        for moment, child in children.items():
            for _ in range(3):
                last[moment] = int(child.stdout.readline())
            time.sleep(np.random.default_rng().uniform(0, 0.1))
            child.kill()
            last[moment] = killed(child, last[moment])
            require_good_after_kill(folders[moment], last[moment])
    for folder in folders.values():
        saved(folder, 7)
        assert checkpoint.UNFINISHED not in listing(folder)


# Quiet and light


def test_nothing_is_printed_and_no_warning_leaks(tmp_path):
    script = """
        import resource, signal, sys
        import jax.numpy as jnp
        from travjax.runs.checkpoint import Checkpoints
        checkpoints = Checkpoints(sys.argv[1])
        for step in range(3):
            checkpoints.save(step, {"x": jnp.ones((300, 1000)) * step}, {})
        checkpoints.restore()
        checkpoints.restore({"x": jnp.ones((300, 1000))})
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
        try:
            checkpoints.save(4, {"x": jnp.ones((300, 1000))}, {})
        except ValueError:
            print("failed as it should")
    """
    child = run(script, tmp_path)
    assert child.communicate(timeout=60) == ("failed as it should\n", "")


def test_reading_the_meta_reads_no_arrays_and_imports_no_orbax(tmp_path):
    saved(tmp_path, 1)
    for file in (tmp_path / "000001-step-1" / "state").rglob("*"):
        if file.is_file():
            os.truncate(file, 0)
    script = """
        import json, sys
        from travjax.runs.checkpoint import load_meta
        print(json.dumps(load_meta(sys.argv[1])))
        assert not [module for module in sys.modules if module.startswith(("orbax", "tensorstore"))]
    """
    child = run(script, tmp_path)
    output, errors = child.communicate(timeout=60)
    assert child.returncode == 0, errors
    assert json.loads(output) == meta_of(1)


# Several processes


TWO_PROCESSES = """
    import sys
    from pathlib import Path
    import jax, jax.numpy as jnp, numpy as np
    from jax.experimental import multihost_utils

    port, process, folder = sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])
    jax.distributed.initialize(f"127.0.0.1:{port}", 2, process)
    from travjax.runs.checkpoint import Checkpoints
    from travjax.config import InputError

    mesh = jax.make_mesh((2,), ("data",))
    def everywhere(value, spec=jax.P()):
        value = np.asarray(value)
        return jax.make_array_from_callback(value.shape, jax.NamedSharding(mesh, spec), lambda index: value[index])
    def state_of(step):
        large = np.arange(50_000, dtype=np.float32).reshape(50, 1000) + step
        half, number = large[0].astype(jnp.bfloat16), np.int32(step)
        return {"x": everywhere(large), "half": everywhere(half), "n": everywhere(number),
                "sharded": everywhere(large, jax.P("data"))}
    def require_equal(one, other):
        for name in one:
            assert one[name].dtype == other[name].dtype and one[name].sharding == other[name].sharding
            for a, b in zip(one[name].addressable_shards, other[name].addressable_shards, strict=True):
                assert np.asarray(a.data).tobytes() == np.asarray(b.data).tobytes()

    checkpoints = Checkpoints(folder / "run")
    for step in (1, 2, 3):
        checkpoints.save(step, state_of(step), {"step": step}, best=step == 1)
    checkpoints.save_named("heads", state_of(4), {"step": 4})
    for which, step in {"latest": 3, "best": 1, "heads": 4}.items():
        state, meta = checkpoints.restore(state_of(0), which)
        require_equal(state, state_of(step))
        assert meta == {"step": step}
    assert (checkpoints.restore()[0]["x"] == np.arange(50_000).reshape(50, 1000) + 3).all()
    if process == 0:
        (folder / "run" / "000003-step-3" / "meta.json").write_text("{}")
        (folder / "file").touch()
    multihost_utils.sync_global_devices("damaged")
    state, meta = checkpoints.restore(state_of(0))
    require_equal(state, state_of(2))
    assert len(checkpoints.notices) == 2
    try:
        Checkpoints(folder / "file").save(1, state_of(1), {})
    except InputError as error:
        print(error)
"""


def test_two_processes_save_and_restore_together(tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    children = [run(TWO_PROCESSES, port, process, tmp_path) for process in range(2)]
    try:
        results = [child.communicate(timeout=60) for child in children]
    finally:
        for child in children:
            child.kill()
    assert [child.returncode for child in children] == [0, 0], results
    messages = [output for output, _ in results]
    assert "file: checkpoint cannot be written: Not a directory; " in messages[0]
    assert "file: checkpoint cannot be written: another process failed; " in messages[1]
    assert listing(tmp_path / "run") == ["000001-step-1-best", "000002-step-2", "000003-step-3", "000004-heads"]
