"""A run of the four services in virtual time: the pace of a real run, without waiting for it.

The services' own code runs under a simulated clock (:mod:`experiments.simulation`), at the pacing ``realtime``: the
world goes on by that clock whatever anyone computes. What takes time in a real run takes it here:

* what crosses from host to host in the mode's placement: the network's table and TCP, by
  :mod:`experiments.virtual_network`;
* an action and an update: the services' settings ``actor.min_inference_s`` and ``learner.min_update_s``, by which a
  fast computer stands for a slow one. Here it stands for every computer: :mod:`experiments.virtual_costs`;
* an observation's and an action's way through the two processes: :data:`MESSAGE_S`, and :data:`CROSSING_S` from host to
  host.

Everything else is done at once: encoding and storing experience, gathering minibatches, applying a policy, waking up.
So no cycle overruns, and a processor that several services share is not modelled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from common.record import write_atomically
from common.topics import ROBOT_BRIDGE
from deploy.network import NetworkConditions
from deploy.placement import Placement
from experiments.in_process import InProcessRun
from experiments.simulation import SimulatedClock
from experiments.virtual_network import VirtualLink, VirtualNetwork

MESSAGE_S = 0.55e-3
"""From a service to another on the same computer, encoding, Zenoh, waking up and decoding, seconds: half of what a real
``local_only`` run takes from observation to action, less the policy's own time (1.2 ms with dot_reacher, 2.1 ms with
visual_dot_reacher)."""

CROSSING_S = 0.35e-3
"""What a message from host to host takes longer than one that stays, over a network without conditions, seconds: two
network stacks and the device in between. Half of the difference between real runs, ``remote_only`` over ``ideal`` (1.71
ms from observation to action) and ``local_only`` (1.02 ms)."""


class VirtualRun(InProcessRun):
    """The services of one run, on two hosts with a network in between, or on one."""

    def __init__(
        self, configurations: Mapping[str, Any], placement: Placement, conditions: NetworkConditions | None
    ) -> None:
        """Args:
        configurations: service -> configuration.
        placement: service -> host.
        conditions: of the network between the hosts; None if nothing crosses it.
        """
        clock = SimulatedClock()
        run = configurations[ROBOT_BRIDGE].run
        self._link = None if conditions is None else VirtualLink(clock, conditions, run.seed)
        self._run_dir = Path(run.directory)
        network = VirtualNetwork(clock, placement.host, self._link, MESSAGE_S, CROSSING_S)
        super().__init__(configurations, clock, network)

    def run(self, look: Callable[[InProcessRun], None], hurried: Callable[[], bool] = lambda: False) -> None:
        """See :class:`InProcessRun`; ends with a trace that stops, and leaves the link's part of the record."""

        def look_at_link_too(run: InProcessRun) -> None:
            look(run)
            if self._link is not None and (over := self._link.over()):
                self.stop(over)

        try:
            super().run(look_at_link_too, hurried)
        finally:
            if self._link is not None:
                write_atomically(self._run_dir / "network.json", self._link.part().to_json())
