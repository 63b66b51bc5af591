"""What a study consists of, as tables: which figure shows which task under which time limits, and how long it runs."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.minimum_time.jobs import DEFAULT_HEAD, HITS, TRAINING, ZERO_HEAD, Job

HIT_STEPS = 20_000
"""Steps in which the initial policy's hits are counted (thesis 6.2)."""

ACTED_STEP_S = {
    "dot_reacher": 0.007,
    "visual_dot_reacher": 0.022,
    "reacher_easy": 0.05,
    "reacher_hard": 0.05,
    "ball_in_cup": 0.05,
    "reacher_easy_visual": 0.17,
    "reacher_hard_visual": 0.17,
    "ball_in_cup_visual": 0.22,
}
"""Task -> seconds of one core for an action cycle with its update, measured on a busy Zen 4; for expected times."""
UNKNOWN_STEP_S = 0.2
HIT_STEP_S = 2e-5
UNTRAINED_STEP_S = 0.0015
RUN_S = 3.0
"""To begin and to end a run."""


@dataclass(frozen=True)
class Panel:
    """One task under several time limits: a set of learning curves."""

    task: str
    preset: str
    limits: tuple[int, ...]
    """Steps."""
    steps: int
    """Of each run, resets included."""
    seeds: int
    heads: tuple[str, ...] = (ZERO_HEAD,)

    @property
    def curves(self) -> tuple[tuple[int, str], ...]:
        """(time limit, head) of each curve."""
        return tuple((limit, head) for limit in self.limits for head in self.heads)


@dataclass(frozen=True)
class Figure:
    """Panels side by side."""

    name: str
    """Also the file's."""
    title: str
    panels: tuple[Panel, ...]


@dataclass(frozen=True)
class Size:
    """A study."""

    name: str
    figures: tuple[Figure, ...]
    hit_seeds: int
    """Seeds of each count of hits with the zero head."""
    window: int
    """The learning curves are means over this many steps."""
    overrides: tuple[str, ...] = ()
    """``section.key=value`` for all runs."""

    @property
    def panels(self) -> tuple[Panel, ...]:
        """All panels of all figures."""
        return tuple(panel for figure in self.figures for panel in figure.panels)

    def jobs(self) -> list[Job]:
        """All jobs, each once: the panels, seed by seed, so that a part of a panel has all limits; then the hits."""
        jobs: dict[Job, None] = {}
        for panel in self.panels:
            for seed in range(panel.seeds):
                for limit, head in panel.curves:
                    jobs[self.training_jobs(panel, limit, head)[seed]] = None
        for panel in self.panels:
            for limit, head in panel.curves:
                jobs |= dict.fromkeys(self.hits_jobs(panel, limit, head))
        return list(jobs)

    def hits_jobs(self, panel: Panel, limit: int, head: str) -> list[Job]:
        """Counts of the hits of a curve's initial policy."""
        # Another head's policy depends on its seed: its hits are counted for the seeds that learn.
        seeds = self.hit_seeds if head == ZERO_HEAD else panel.seeds
        return [Job(HITS, panel.task, panel.preset, limit, head, HIT_STEPS, seed) for seed in range(seeds)]

    def training_jobs(self, panel: Panel, limit: int, head: str) -> list[Job]:
        """Runs of a curve."""
        return [Job(TRAINING, panel.task, panel.preset, limit, head, panel.steps, seed) for seed in range(panel.seeds)]


def expected_s(job: Job, reset_steps: int) -> float:
    """Seconds that a job takes one core, roughly.

    Args:
        job: to be done.
        reset_steps: of its task.
    """
    acted = job.steps * job.limit / (job.limit + reset_steps)  # at most: as if no goal were ever reached in time
    if job.kind == TRAINING:
        return RUN_S + acted * ACTED_STEP_S.get(job.task, UNKNOWN_STEP_S)
    return acted * HIT_STEP_S if job.head == ZERO_HEAD else RUN_S + acted * UNTRAINED_STEP_S


_HEADS = (ZERO_HEAD, DEFAULT_HEAD)

SMALL = Size(
    name="small",
    hit_seeds=30,
    window=500,
    figures=(
        Figure(
            "learning_curves",
            "SAC under several time limits",
            (
                # 10, 50 and 500 differ little in hits: the shorter ones are there to have some with few.
                Panel("dot_reacher", "demo", (2, 5, 10, 25, 50, 500), steps=5000, seeds=8),
                Panel("visual_dot_reacher", "demo", (2, 10, 50, 500), steps=7000, seeds=5),
            ),
        ),
        Figure(
            "initialisation",
            "The actor's last layer: zero, or as torch initialises it",
            (Panel("dot_reacher", "demo", (50,), steps=5000, seeds=8, heads=_HEADS),),
        ),
    ),
)
"""For two cores, within an hour."""

_STEPS, _SEEDS = 200_000, 30
# The thesis's text does not say which limits figure 7.3 shows; these are those of figure 7.2 that 10 hits or the
# minimum steps do not rule out at a glance.
_LIMITS_7_3 = (10, 25, 50, 100, 500, 1000, 5000)
_LIMITS_8_5 = (50, 100, 500)
"""Section 8.2."""


def _thesis(task: str, limits: tuple[int, ...], heads: tuple[str, ...] = (ZERO_HEAD,)) -> Panel:
    return Panel(task, "thesis", limits, _STEPS, _SEEDS, heads)


THESIS = Size(
    name="thesis",
    hit_seeds=30,
    window=5000,
    overrides=("algorithm.replay_capacity=100000",),  # section 7.3; the public presets of these tasks hold a tenth
    figures=(
        Figure(
            "figure_6_2",
            "Minimum-time Reacher, reset after 1000 steps (thesis, figure 6.2)",
            (_thesis("reacher_easy", (1000,)), _thesis("reacher_hard", (1000,))),
        ),
        Figure(
            "figure_7_3",
            "SAC under several time limits (thesis, figure 7.3)",
            (
                _thesis("ball_in_cup", _LIMITS_7_3),
                _thesis("ball_in_cup_visual", _LIMITS_7_3),
                _thesis("reacher_easy", _LIMITS_7_3),
                _thesis("reacher_hard", _LIMITS_7_3),
            ),
        ),
        Figure(
            "figure_8_5",
            "Held-out tasks (thesis, figure 8.5)",
            (
                _thesis("reacher_easy_visual", _LIMITS_8_5),
                _thesis("reacher_hard_visual", _LIMITS_8_5),
                _thesis("dot_reacher", _LIMITS_8_5),
            ),
        ),
        Figure(
            "visual_dot_reacher",
            "Visual Dot-Reacher, which the thesis does not have",
            (_thesis("visual_dot_reacher", _LIMITS_8_5),),
        ),
        Figure(
            "initialisation",
            "The actor's last layer: zero, or as torch initialises it",
            (_thesis("dot_reacher", (50,), _HEADS), _thesis("reacher_easy", (50,), _HEADS)),
        ),
    ),
)
"""As the thesis: 30 seeds, 200 000 steps; days on many cores."""

SIZES = {size.name: size for size in (SMALL, THESIS)}
