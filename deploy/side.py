"""One computer's side of a run on two: agree with the other launcher, start this side's services, summarise both."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from common.console import Console
from common.errors import ConfigError
from common.run_settings import RunSettings, TransportSettings
from common.stop_signals import INTERRUPTED, StopSignals
from common.topics import ROBOT_BRIDGE, Lane
from common.transport import ZenohTransport
from deploy.agreement import RELEASE, RUN_ID, differences, facts_of, host_fact
from deploy.computers import TwoComputers, other_host
from deploy.listener import INTERRUPTED_S, SILENT_S, Listener
from deploy.mirror import write_ring_counts
from deploy.network import HOSTS, Host
from deploy.options import LaunchOptions, Side
from deploy.other_side import ENDED, LAUNCHERS_RUN, RUNNING, News, OtherSide
from deploy.plan import PORTS, PortMap, plan_run
from deploy.ports import DEFAULT_BASE_PORT, check_base_port, held_ports
from deploy.progress import ProgressReader
from deploy.run import launched_services, run_file, summarise_run, write_tables
from deploy.run_file import REPOSITORY
from deploy.run_record import RING, read_record
from deploy.watch import OVERTIME_S, Drawing, watch

SIDE_PORTS = PORTS + len(HOSTS) * len(Lane)
"""Ports of a run on two computers: the services', then those of the launchers themselves."""

_POLL_S = 0.05
_TOLD_S = 2.0
"""Longest time that the other launcher may need for an answer or a file, once it has one."""
_STOPPING_S = 5.0
"""Longest time that the other side needs to stop its services and settle its record."""


def launch_side(options: LaunchOptions, side: Side, stop: StopSignals, console: Console) -> int:
    """Run this side's services from the agreement with the other side to the summary; return the exit code."""
    request = options.request
    run_dir = request.run_dir
    if run_dir.exists() and (not run_dir.is_dir() or any(run_dir.iterdir())):
        raise ConfigError(f"--run-dir {run_dir}: expected a folder that is empty or not there yet")
    base_port = DEFAULT_BASE_PORT if options.base_port is None else options.base_port
    check_base_port(base_port, SIDE_PORTS)
    port_map = PortMap(range(base_port, base_port + PORTS))
    link = TwoComputers(side.addresses)
    configurations = plan_run(request, port_map, link, None)
    facts = facts_of(request.placement, side.addresses, base_port, side.run_id, configurations)
    own = request.placement.services_on(side.host)
    ports = [port_map.port(service, lane) for service in own for lane in Lane]
    with held_ports([*ports, *_launcher_ports(side.host, base_port).values()], side.addresses[side.host]):
        transport = ZenohTransport(
            RunSettings(LAUNCHERS_RUN, str(run_dir)), _launcher_settings(side.host, side.addresses, base_port)
        )
        other = OtherSide(transport, side.host, other_host(side.host), run_dir)
        try:
            other.tell(facts=facts)
            other.start()
            run_id = _agree(other, facts, side, base_port, stop, console)
            if run_id is None:
                return INTERRUPTED
            # Only now is the run's name known on both sides.
            configurations = plan_run(replace(request, run_id=run_id), port_map, link, None)
            return _run(options, side, configurations, link, other, stop, console)
        finally:
            other.close()


def _run(
    options: LaunchOptions,
    side: Side,
    configurations: dict[str, Any],
    link: TwoComputers,
    other: OtherSide,
    stop: StopSignals,
    console: Console,
) -> int:
    placement, run_dir = options.request.placement, options.request.run_dir
    run_dir.mkdir(parents=True, exist_ok=True)
    own = placement.services_on(side.host)
    paths = write_tables(run_dir / "config", {service: configurations[service] for service in own})
    run_file(options, configurations, link).write(run_dir)
    services = launched_services(paths, placement, link)
    console.line(f"run {configurations[ROBOT_BRIDGE].run.id}, {side.host}: {', '.join(own)}")
    console.line(f"run directory: {run_dir}")
    has_bridge = placement.host[ROBOT_BRIDGE] == side.host
    folders = (run_dir, other.mirror.folder) if has_bridge else (other.mirror.folder, run_dir)
    reader = ProgressReader(folders[0], configurations[ROBOT_BRIDGE].robot_bridge.steps, other_dirs=folders[1:])
    other.share_files()
    other.tell(phase=RUNNING, restart=[f"cd {REPOSITORY}", *(service.command_line() for service in services)])

    def report(text: str) -> None:
        console.error(text)
        other.say(text)

    listener = Listener(other, console, robot_is_here=has_bridge, run_has_begun=lambda: reader.read().steps > 0)
    drawing = Drawing()
    failures = watch(services, reader, run_dir, drawing, stop, console, early_end=listener.early_end, report=report)
    listener.note_end()
    outcome = "stopped by Ctrl-C" if stop.asked else "; ".join(failures) or "well"
    _leave_ring_counts(run_dir)
    other.tell(phase=ENDED, outcome=outcome, succeeded=not failures and not stop.asked)
    _exchange_records(other, listener, has_bridge, stop, console)
    complete = summarise_run(run_dir, drawing, stop, console)
    if stop.asked:
        return INTERRUPTED
    return 0 if complete and not failures else 1


def _agree(
    other: OtherSide, facts: dict[str, str], side: Side, base_port: int, stop: StopSignals, console: Console
) -> str | None:
    """Wait for the other launcher; return the id of the run that both have agreed on, None after Ctrl-C.

    Raises:
        ConfigError: the other side starts another run, or there is none in time.
    """
    here, there = side.host, other.there
    console.line(f"waiting for the launcher of {there} ({side.addresses[there]}), started with --host {there}")
    begun_s = time.monotonic()
    while not stop.asked:
        news = other.news
        if news is not None and news.facts:
            _check_same_run(other, facts, news, here, there, console)
            if run_id := facts.get(RUN_ID, news.facts.get(RUN_ID)):
                other.agree()
                return run_id
        if time.monotonic() - begun_s > side.wait_s:
            endpoints = ", ".join(f"{host} = {side.addresses[host]}" for host in HOSTS)
            listening = _launcher_ports(HOSTS[0], base_port)[Lane.REAL_TIME]
            raise ConfigError(
                f"no launcher of {there!r} within {side.wait_s:g} s. Was `deploy.launch MODE --host {there}` started "
                f"there, with the same endpoints ({endpoints}) and the same --base-port ({base_port})? Does a firewall "
                f"let {HOSTS[1]} reach port {listening} of {HOSTS[0]}? --wait S waits longer"
            )
        time.sleep(_POLL_S)
    return None


def _check_same_run(
    other: OtherSide, facts: dict[str, str], news: News, here: Host, there: Host, console: Console
) -> None:
    if other.is_taken(news):
        raise ConfigError(_refusal(here, there, robot_is_here=facts[host_fact(ROBOT_BRIDGE)] == here))
    unequal = differences(facts, news.facts, here, there)
    if unequal:
        time.sleep(_TOLD_S)  # The other side shall hear of it, too.
        raise ConfigError(
            "the two sides do not start the same run; give the same command on both, but for --host and --run-dir:\n"
            + "\n".join(f"  {line}" for line in unequal)
        )
    if facts[RELEASE] != news.facts.get(RELEASE):
        console.error(
            f"deploy.launch: warning: release {facts[RELEASE]} here, {news.facts.get(RELEASE)} on {there}; settings "
            "and messages are the same"
        )


def _refusal(here: Host, there: Host, *, robot_is_here: bool) -> str:
    """What a launcher is told that comes back to a run whose first launcher here was killed."""
    refusal = (
        f"the launcher of {there!r} is in a run with another launcher of {here!r}, which only that one can take part "
        f"in; end the run on {there}, with Ctrl-C if need be, and start both sides anew"
    )
    if not robot_is_here:
        refusal += (
            f". Or let that run go on: the launcher on {there} shows the commands that start the services of {here} "
            f"again, once it has heard nothing of the other one for {SILENT_S:.0f} s"
        )
    return refusal


def _leave_ring_counts(run_dir: Path) -> None:
    """What killed services have left is settled, and the ring counted: from now on this side's files are final."""
    record = read_record(run_dir)
    if (run_dir / RING).exists() and record.ring is not None:
        write_ring_counts(run_dir, **vars(record.ring))


def _exchange_records(
    other: OtherSide, listener: Listener, has_bridge: bool, stop: StopSignals, console: Console
) -> None:
    """Wait until both sides have the whole record, or it is clear that they will not."""
    begun_s = time.monotonic()
    stopped_before = stop.asked
    while True:
        listener.listen()
        news = other.news
        there_ended = news is not None and news.phase == ENDED
        if there_ended and news is not None and news.has_record and other.has_record:
            return
        waited_s = time.monotonic() - begun_s
        # Where the robot's side has ended, the other one ends soon; where it has not, it goes on.
        ends_soon = has_bridge or there_ended
        if not ends_soon and news is not None and news.has_record:
            break
        limit_s = _STOPPING_S + (INTERRUPTED_S if stop.asked else OVERTIME_S) if ends_soon else _TOLD_S
        if waited_s > limit_s or other.silent_s > SILENT_S or (stop.asked and not stopped_before):
            break
        console.status(f"waiting for {other.there} to end, for its part of the record")
        time.sleep(_POLL_S)
    if listener.was_left_alone or not other.has_record:
        other.mirror.note_outdated()


def _launcher_ports(host: Host, base_port: int) -> dict[Lane, int]:
    first = base_port + PORTS + HOSTS.index(host) * len(Lane)
    return dict(zip(Lane, range(first, first + len(Lane)), strict=True))


def _launcher_settings(host: Host, addresses: Any, base_port: int) -> TransportSettings:
    """The launcher's own session; ``remote`` connects to ``local``, as its services do."""

    def endpoints(of: Host) -> dict[Lane, str]:
        return {lane: f"tcp/{addresses[of]}:{port}" for lane, port in _launcher_ports(of, base_port).items()}

    dialled = {} if host == HOSTS[0] else endpoints(HOSTS[0])
    return TransportSettings(
        listen_real_time=endpoints(host)[Lane.REAL_TIME],
        listen_bulk=endpoints(host)[Lane.BULK],
        connect_real_time=[dialled[Lane.REAL_TIME]] if dialled else [],
        connect_bulk=[dialled[Lane.BULK]] if dialled else [],
    )
