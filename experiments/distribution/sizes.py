"""What a study consists of: which configurations learn which task, for how long, with how many seeds."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.distribution.configurations import PPO, SAC, SAC_PENDING, Configuration
from experiments.distribution.jobs import Job

_RUN_S = 1.0
_LAUNCH_S = 10.0
_CYCLE_S = 0.04
"""Of a task in real time."""
_STEP_S = {"dot_reacher": 0.0013, "visual_dot_reacher": 0.003}
"""Task -> seconds of one core for an action cycle without its update; for expected times."""
_UPDATE_S = {"dot_reacher": 0.004, "visual_dot_reacher": 0.019}
"""The same for an update of SAC."""
_UPDATES_PER_STEP = {"workstation": 1.0, "laptop": 1 / 3, "jetson": 1 / 12}


@dataclass(frozen=True)
class Panel:
    """Configurations that learn one task for equally long."""

    name: str
    """Also the figure's file."""
    title: str
    task: str
    configurations: tuple[Configuration, ...]
    steps: int
    """Of each run, resets included."""
    seeds: int
    window: int
    """The learning curves are means over this many steps."""
    overrides: tuple[str, ...] = ()
    """``section.key=value`` for all runs."""
    real_time: bool = False
    """Whether the launcher runs them, and not :mod:`experiments.train`."""

    def job(self, configuration: Configuration, seed: int) -> Job:
        """One run."""
        return Job(configuration.name, self.task, self.steps, seed)


@dataclass(frozen=True)
class Size:
    """A study."""

    name: str
    panels: tuple[Panel, ...]

    def jobs(self) -> list[Job]:
        """All runs, each once, seed by seed, so that a part of a panel has all configurations."""
        every = (
            panel.job(configuration, seed)
            for panel in self.panels
            for seed in range(panel.seeds)
            for configuration in panel.configurations
        )
        return list(dict.fromkeys(every))

    def panel_of(self, job: Job) -> tuple[Panel, Configuration]:
        """Where a job belongs."""
        return next(
            (panel, configuration)
            for panel in self.panels
            for configuration in panel.configurations
            if (configuration.name, panel.task, panel.steps) == (job.configuration, job.task, job.steps)
        )

    @property
    def real_time(self) -> bool:
        """Whether a run needs the computer for itself: side by side, or on one core, runs would hold each other up."""
        return any(panel.real_time for panel in self.panels)

    def expected_s(self, job: Job) -> float:
        """Seconds that a job takes one core, roughly."""
        panel, configuration = self.panel_of(job)
        if panel.real_time:
            return _LAUNCH_S + job.steps * _CYCLE_S
        step_s = _STEP_S.get(job.task, max(_STEP_S.values()))
        if configuration.algorithm == "sac":
            step_s += _UPDATES_PER_STEP[configuration.host] * _UPDATE_S.get(job.task, max(_UPDATE_S.values()))
        return _RUN_S + job.steps * step_s


def _sac(task: str, steps: int, seeds: int) -> Panel:
    return Panel(f"sac_{task}", f"SAC, {task}", task, SAC, steps, seeds, window=500)


def _pending(task: str, steps: int, seeds: int) -> Panel:
    """The ablation beside what it is held against; those runs are the same as in :func:`_sac`."""
    without = {pending.name.removesuffix("_pending") for pending in SAC_PENDING}
    configurations = tuple(c for c in SAC if c.name in without) + SAC_PENDING
    title = f"SAC with and without pending actions, {task}"
    return Panel(f"sac_pending_{task}", title, task, configurations, steps, seeds, window=500)


def _ppo(steps: int, seeds: int) -> Panel:
    return Panel("ppo_dot_reacher", "PPO, dot_reacher", "dot_reacher", PPO, steps, seeds, window=2000)


# Too short and too few to tell configurations apart that are close to each other.
GLANCE = Size("glance", (_sac("dot_reacher", 3000, 4),))
SMALL = Size(
    "small",
    (
        _sac("dot_reacher", 5000, 20),
        _sac("visual_dot_reacher", 5000, 10),
        _pending("dot_reacher", 5000, 20),
    ),
)
# Before 50 000 steps single seeds have not learnt, and whether they have hides every difference between modes.
PPO_ONLY = Size("ppo", (_ppo(150_000, 20),))
THESIS = Size(
    "thesis",
    (
        _sac("dot_reacher", 10_000, 30),
        _ppo(150_000, 30),
        _sac("visual_dot_reacher", 10_000, 10),
        _pending("dot_reacher", 10_000, 30),
    ),
)
REAL = Size(
    "real",
    (Panel("real_sac_dot_reacher", "SAC in real time, dot_reacher", "dot_reacher", SAC, 5000, 3, 500, real_time=True),),
)
SIZES = {size.name: size for size in (SMALL, PPO_ONLY, THESIS, GLANCE, REAL)}
