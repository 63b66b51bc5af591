"""Opens the best link this machine allows."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal, get_args

from deploy.network.conditions import NetworkConditions
from deploy.network.errors import LinkUnavailable
from deploy.network.link import Crossing, NetworkLink, NoLink
from deploy.network.namespaces import NamespaceLink
from deploy.network.netem_link import NetemLink
from deploy.network.relay_link import RelayLink

LinkPreference = Literal["auto", "namespaces", "netem", "relay"]
LINK_PREFERENCES: tuple[LinkPreference, ...] = get_args(LinkPreference)

_log = logging.getLogger(__name__)


@contextlib.contextmanager
def open_link(
    conditions: NetworkConditions | None,
    *,
    needs: Iterable[Crossing],
    run_dir: Path,
    prefer: LinkPreference = "auto",
    seed: int = 0,
) -> Iterator[NetworkLink]:
    """Open the network between the hosts for as long as the ``with`` block lasts.

    ``needs`` are the crossings that the services' placement asks for; without any, or without
    ``conditions``, there is nothing to emulate and the link is a :class:`NoLink`. ``auto`` takes
    namespaces, or else the relay, with a warning; ``namespaces`` raises :class:`LinkUnavailable` instead. ``netem``,
    which is less exact, is never chosen for anyone.
    ``run_dir`` receives ``network.json``, the link's part of the record, and ``network.log``.
    """
    crossings = tuple(needs)
    with contextlib.ExitStack() as stack:
        if conditions is None or not crossings:
            yield stack.enter_context(NoLink())
        elif prefer == "relay":
            yield stack.enter_context(RelayLink(conditions, run_dir, crossings, seed))
        elif prefer == "netem":
            yield stack.enter_context(NetemLink(conditions, run_dir))
        else:
            yield _enter_best(stack, conditions, run_dir, crossings, prefer, seed)


def _enter_best(
    stack: contextlib.ExitStack,
    conditions: NetworkConditions,
    run_dir: Path,
    crossings: tuple[Crossing, ...],
    prefer: LinkPreference,
    seed: int,
) -> NetworkLink:
    try:
        return stack.enter_context(NamespaceLink(conditions, run_dir, seed))
    except LinkUnavailable as error:
        if prefer == "namespaces":
            raise
        _log.warning(
            "the network is emulated by a TCP relay, because %s. What is lost: real packet loss and TCP's answer "
            "to it, the kernel's byte counters, and hosts that cannot reach each other around the link",
            error,
        )
    return stack.enter_context(RelayLink(conditions, run_dir, crossings, seed))
