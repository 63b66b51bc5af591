"""On a GPU the learner computes what it does on the CPU, from frames that stay there, and never waits for it."""

from __future__ import annotations

import contextlib
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from common.algorithms.sac import SAC
from common.algorithms.sac_config import SACConfig
from common.frame_ring import RingReader, crop_shape, draw_crop_offset, drop_overtaken
from common.policies import policy_from_weights
from services.learner import device_frames
from services.learner.device import open_device
from services.learner.device_frames import DeviceRingReader, free_bytes
from tests.common.ring_cases import Bridge, task_spec
from tests.common.test_frame_ring import append_all, every_pair, make_ring
from tests.reference.tasks import make_minibatch, make_observation, make_spec

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")

CONFIG = SACConfig(batch_size=16, hidden_size=48, encoder_strides=(2, 2, 1, 1), discount=0.97)
SPECS = {"no camera": make_spec(), "camera": make_spec((32, 36, 3))}
FRAME_BYTES = 6 * 8 * 3


@pytest.fixture(autouse=True, scope="module")
def gpu():
    """The GPU as the learner opens it."""
    before = torch.backends.cudnn.conv.fp32_precision, torch.backends.cuda.matmul.fp32_precision
    yield open_device("cuda")
    torch.backends.cudnn.conv.fp32_precision, torch.backends.cuda.matmul.fp32_precision = before


@pytest.fixture(params=SPECS)
def spec(request):
    return SPECS[request.param]


def same_noise(device, dtype):
    """Numbers that depend on nothing but how many were drawn."""
    rng = np.random.default_rng(7)
    return lambda rows, columns: torch.from_numpy(rng.standard_normal((rows, columns))).to(device, dtype)


def on_both(spec, dtype, config=CONFIG, **options):
    """Return the same algorithm on the CPU and on the GPU."""
    return [
        SAC(spec, config, seed=0, device=device, dtype=dtype, noise=same_noise(device, dtype), **options)
        for device in ("cpu", "cuda")
    ]


@contextlib.contextmanager
def waiting_forbidden():
    """Let everything fail that waits for the GPU."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that this is a prototype, which does not find everything
        torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


# ---------------------------------------------------------------------- updates


def test_every_parameter_agrees_with_the_cpus_after_five_updates_in_float64(spec):
    cpu, cuda = on_both(spec, torch.float64)
    rng = np.random.default_rng(1)
    for _ in range(5):
        minibatch = make_minibatch(spec, rng)
        cpu.update(minibatch)
        cuda.update(minibatch)
    expected, got = cpu.state_dict(), cuda.state_dict()
    assert expected.keys() == got.keys()
    for name in expected.keys() - {"random_state"}:
        np.testing.assert_allclose(got[name], expected[name], rtol=0.0, atol=1e-9, err_msg=name)


def test_gradients_agree_with_the_cpus_in_float32_which_is_no_tf32(spec):
    cpu, cuda = on_both(spec, torch.float32, precision="float32")
    # Below a zero last layer there is no gradient.
    rng, state = np.random.default_rng(1), cpu.state_dict()
    state["actor.2.weight"] = rng.normal(0.0, 0.1, state["actor.2.weight"].shape)
    minibatch = make_minibatch(spec, rng)
    for algorithm in (cpu, cuda):
        algorithm.load_state_dict(state)
        algorithm.update(minibatch)
    for module in ("actor", "critic", "encoder"):
        if getattr(cpu, module) is None:
            continue
        theirs = dict(getattr(cpu, module).named_parameters())
        for name, parameter in getattr(cuda, module).named_parameters():
            expected, got = theirs[name].grad.numpy(), parameter.grad.cpu().numpy()
            assert np.linalg.norm(got - expected) <= 1e-4 * np.linalg.norm(expected), f"{module}.{name}"


def test_losses_in_bfloat16_stay_within_one_percent(spec):
    config, losses = replace(CONFIG, batch_size=64, hidden_size=128), {}
    for precision in ("float32", "bfloat16"):
        _, sac = on_both(spec, torch.float32, config, precision=precision)
        rng, losses[precision] = np.random.default_rng(1), []
        for _ in range(10):
            sac.update(make_minibatch(spec, rng, 64))
            losses[precision].append([sac.metrics()["critic_loss"], sac.metrics()["actor_loss"]])
    half, full = np.array(losses["bfloat16"]), np.array(losses["float32"])
    assert (np.abs(half - full).max(axis=0) <= 0.01 * np.abs(full).mean(axis=0)).all()


@pytest.mark.parametrize("frames", ["on the host", "on the GPU"])
def test_an_update_never_waits_for_the_gpu(spec, frames):
    sac, rng = SAC(spec, CONFIG, seed=0, device="cuda"), np.random.default_rng(1)
    minibatches = [make_minibatch(spec, rng) for _ in range(3)]
    if spec.has_camera and frames == "on the GPU":
        minibatches = [
            replace(m, **{name: torch.tensor(getattr(m, name), device="cuda") for name in ("frames", "next_frames")})
            for m in minibatches
        ]
    sac.update(minibatches[0])  # libraries wait when they are first used
    with waiting_forbidden():
        for minibatch in minibatches:
            sac.update(minibatch)
    assert all(np.isfinite(value) for value in sac.metrics().values())


def test_equal_seeds_draw_equal_numbers():
    one, same, other = (SAC(SPECS["no camera"], CONFIG, seed=seed, device="cuda") for seed in (3, 3, 4))
    for _ in range(2):
        drawn = one._random_noise(16, 2)
        assert drawn.device.type == "cuda"
        assert torch.equal(drawn, same._random_noise(16, 2))
        assert not torch.equal(drawn, other._random_noise(16, 2))


# ---------------------------------------------------------------------- what leaves the GPU


def test_a_checkpoint_is_complete(spec):
    rng, sac = np.random.default_rng(1), SAC(spec, CONFIG, seed=0, device="cuda")
    sac.update(make_minibatch(spec, rng))
    state, resumed = sac.state_dict(), SAC(spec, CONFIG, seed=1, device="cuda")
    resumed.load_state_dict(state)
    for name, value in resumed.state_dict().items():
        np.testing.assert_array_equal(value, state[name], err_msg=name)
    assert torch.equal(sac._random_noise(16, 2), resumed._random_noise(16, 2))


@pytest.mark.parametrize(("source", "target"), [("cpu", "cuda"), ("cuda", "cpu")])
def test_a_checkpoint_goes_on_on_the_other_device(spec, source, target):
    rng, original = np.random.default_rng(1), SAC(spec, CONFIG, seed=0, device=source)
    original.update(make_minibatch(spec, rng))
    state, resumed = original.state_dict(), SAC(spec, CONFIG, seed=1, device=target)
    resumed.load_state_dict(state)
    for name, value in resumed.state_dict().items():
        if name != "random_state":
            np.testing.assert_array_equal(value, state[name], err_msg=name)
    resumed.update(make_minibatch(spec, rng))
    assert resumed.updates == 2


def test_a_pushed_policy_is_the_one_that_the_cpu_would_push(spec):
    cpu, cuda = SAC(spec, CONFIG, seed=0), SAC(spec, CONFIG, seed=1, device="cuda")
    rng = np.random.default_rng(1)
    cpu.update(make_minibatch(spec, rng))
    cuda.load_state_dict(cpu.state_dict())
    weights = cuda.policy_weights(3, "float32")
    assert weights.digest == cpu.policy_weights(3, "float32").digest
    assert np.isfinite(policy_from_weights(spec, weights).act(make_observation(spec, rng), rng).action).all()


# ---------------------------------------------------------------------- frames on the GPU


@pytest.fixture
def path(tmp_path):
    return tmp_path / "ring"


@pytest.mark.parametrize("frames_per_row", [4.0, 0.5])
def test_minibatches_are_those_from_the_ring_through_several_wraps(path, gpu, monkeypatch, frames_per_row):
    monkeypatch.setattr(device_frames, "CHUNK_BYTES", 3 * FRAME_BYTES)
    spec, ring, bridge = task_spec(), make_ring(path, 40, frames_per_row), Bridge()
    resident, mapped, rng = DeviceRingReader(path, gpu), RingReader(path), np.random.default_rng(1)
    assert resident.on_device
    for _ in range(20):
        append_all(ring, bridge.wander(rng, 13))
        rows = rng.integers(ring.rows_appended - 60, ring.rows_appended + 5, 32)
        crop = draw_crop_offset(spec, rng), draw_crop_offset(spec, rng)
        ours = resident.gather(rows, crop_shape(spec), *crop)
        theirs = mapped.gather(rows, crop_shape(spec), *crop)
        np.testing.assert_array_equal(ours.valid, theirs.valid)
        ours, theirs = drop_overtaken(ours), drop_overtaken(theirs)
        assert ours.frames.device.type == "cuda"
        for name in ("frames", "next_frames"):
            np.testing.assert_array_equal(getattr(ours, name).cpu().numpy(), getattr(theirs, name), strict=True)
        np.testing.assert_array_equal(ours.next_proprioception, theirs.next_proprioception)


def test_frames_are_not_replaced_before_a_minibatch_has_them(path, gpu):
    ring, bridge = make_ring(path, 30, 1.0), Bridge()
    append_all(ring, [bridge.start(), *(bridge.step() for _ in range(29))])
    resident, mapped, rows = DeviceRingReader(path, gpu), RingReader(path), every_pair(ring)
    resident.gather(rows)
    busy = torch.ones(2000, 2000, device=gpu)
    for _ in range(50):
        busy = busy @ busy  # work that what follows has to queue behind
    minibatch, expected = resident.gather(rows).minibatch, mapped.gather(rows).minibatch
    append_all(ring, [bridge.step() for _ in range(30)])
    resident.gather(every_pair(ring))
    np.testing.assert_array_equal(minibatch.frames.cpu().numpy(), expected.frames)


def test_a_gather_never_waits_for_the_gpu(path, gpu):
    ring, bridge = make_ring(path, 30, 1.0), Bridge()
    append_all(ring, [bridge.start(), *(bridge.step() for _ in range(40))])
    resident = DeviceRingReader(path, gpu)
    resident.gather(every_pair(ring), (4, 4))
    with waiting_forbidden():
        for _ in range(3):
            append_all(ring, [bridge.step()])
            rows = every_pair(ring)
            got = resident.gather(rows, (4, 4))
    assert got.valid.all()
    assert got.minibatch.frames.shape == (len(rows), 4, 4, 9)


def test_free_memory_is_the_gpus(gpu):
    assert 0 < free_bytes(gpu) <= torch.cuda.get_device_properties(gpu).total_memory
