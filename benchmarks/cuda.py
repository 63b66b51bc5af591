"""``python -m benchmarks.cuda``: what a GPU makes of the learner, and what frames that stay on it are worth.

A minibatch of the thesis's images from frames on the host and from frames on the device, an update, and both together
as in the learner, which gathers the next minibatch during an update. Without a GPU it says so and measures nothing.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import islice, repeat
from pathlib import Path
from statistics import median

import numpy as np
import torch

from benchmarks.scene import recorded_experience, thesis_config, thesis_task
from common.algorithms.sac import SAC
from common.algorithms.upload import upload
from common.cpu_tuning import tune_process
from common.errors import ConfigError
from common.frame_ring import RING_FILE, RingReader, RingWriter, crop_shape, draw_crop_offset, drop_overtaken
from common.messages import Experience
from common.minibatch import Minibatch
from common.networks.precision import Precision
from services.learner.device import open_device
from services.learner.device_frames import DeviceRingReader
from services.replay.sampler import TransitionSampler

WARM_UP = 5
"""Calls before those that count: libraries choose their kernels, memory is reserved."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    batch_size: int
    rows: int
    """Experiences that the ring holds."""
    calls: int
    hidden_size: int


class Ring:
    """A full experience ring to which one experience, with one frame, comes before each minibatch."""

    def __init__(self, directory: Path, sizes: Sizes) -> None:
        self.spec, self.path, self._sizes = thesis_task(camera=True), directory / RING_FILE, sizes
        self._writer = RingWriter.create_or_reopen(self.path, self.spec, sizes.rows, frames_per_row=1.0)
        self._experience: Iterator[Experience] = recorded_experience(self.spec)
        for experience in islice(self._experience, sizes.rows):
            self._writer.append(experience)
        self._rng = np.random.default_rng(0)
        self._sampler = TransitionSampler(self._rng)

    def minibatch(self, reader: RingReader) -> Minibatch:
        """Draw transitions, gather and crop them."""
        self._writer.append(next(self._experience))
        rows = self._sampler.sample(reader, self._sizes.batch_size)
        assert rows is not None
        crop = crop_shape(self.spec), draw_crop_offset(self.spec, self._rng)
        minibatch = drop_overtaken(reader.gather(rows, *crop))
        assert minibatch is not None
        return minibatch

    def close(self) -> None:
        """Let go of the file."""
        self._writer.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cuda", description=__doc__)
    parser.add_argument("--device", default="cuda", help="torch device (default: cuda); cpu shows that it runs")
    parser.add_argument("--batch-size", type=int, default=256, metavar="N", help="transitions (default: 256)")
    parser.add_argument("--rows", type=int, default=5000, metavar="N", help="experiences in the ring (default: 5000)")
    parser.add_argument("--calls", type=int, default=100, metavar="N", help="of everything (default: 100)")
    parser.add_argument("--hidden-size", type=int, default=1024, metavar="N", help="width (default: 1024)")
    options = parser.parse_args(arguments)
    try:
        device = open_device(options.device)
    except ConfigError as error:
        print(f"nothing was measured: {error}")
        return 0
    sizes = Sizes(options.batch_size, options.rows, options.calls, options.hidden_size)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU"
    print(f"{device}: {name}; torch {torch.__version__}; {torch.get_num_threads()} CPU threads; {sizes}")
    with tempfile.TemporaryDirectory() as directory:
        ring = Ring(Path(directory), sizes)
        _measure(ring, device, sizes)
        ring.close()
    return 0


def _measure(ring: Ring, device: torch.device, sizes: Sizes) -> None:
    readers = {"host": RingReader(ring.path), "device": DeviceRingReader(ring.path, device)}
    for where, reader in readers.items():
        milliseconds = _median_ms(partial(_bring, ring, reader, device), sizes.calls)
        print(f"{f'minibatch, frames on the {where}':36}{milliseconds:10.2f} ms")
    precisions: tuple[Precision, ...] = ("float32", "bfloat16")
    for precision in precisions:
        config = thesis_config(batch_size=sizes.batch_size, hidden_size=sizes.hidden_size)
        algorithm = SAC(ring.spec, config, seed=0, device=str(device), precision=precision)
        always_the_same = repeat(_bring(ring, readers["device"], device))
        rate = _rate(always_the_same.__next__, algorithm, sizes.calls, device)
        print(f"{f'{precision}, update alone':36}{rate:10.1f} updates/s")
        for where, reader in readers.items():
            rate = _rate(partial(ring.minibatch, reader), algorithm, sizes.calls, device)
            print(f"{f'{precision}, frames on the {where}':36}{rate:10.1f} updates/s")
    for reader in readers.values():
        reader.close()


def _bring(ring: Ring, reader: RingReader, device: torch.device) -> Minibatch:
    """Return a minibatch whose frames have arrived on the device."""
    values = dict(vars(ring.minibatch(reader)))
    for name in ("frames", "next_frames"):
        if isinstance(values[name], np.ndarray):
            values[name] = upload(values[name], device)
    _wait(device)
    return Minibatch(**values)


def _median_ms(call: Callable[[], object], calls: int) -> float:
    durations = []
    for _ in range(WARM_UP + calls):
        begun = time.perf_counter()
        call()
        durations.append(time.perf_counter() - begun)
    return 1e3 * median(durations[WARM_UP:])


def _rate(gather: Callable[[], Minibatch], algorithm: SAC, calls: int, device: torch.device) -> float:
    """Return updates per second with the next minibatch gathered meanwhile."""
    with ThreadPoolExecutor(1) as thread:
        following = thread.submit(gather)
        for call in range(WARM_UP + calls):
            if call == WARM_UP:
                _wait(device)
                begun = time.perf_counter()
            minibatch, following = following.result(), thread.submit(gather)
            algorithm.update(minibatch)
        _wait(device)
        return calls / (time.perf_counter() - begun)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


if __name__ == "__main__":
    tune_process()
    sys.exit(main())
