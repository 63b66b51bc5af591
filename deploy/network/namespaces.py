"""Two network namespaces, and the packet link that joins them: the emulation to trust, for those who may use it."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import shutil
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self

from common.errors import ConfigError
from deploy.network.conditions import HOSTS, Direction, Host, NetworkConditions
from deploy.network.errors import LinkFailedError, LinkUnavailable
from deploy.network.link_process import LinkProcess
from deploy.network.part import NetworkPart

DEVICE = "net0"
MTU_BYTES = 1500

_log = logging.getLogger(__name__)
_NAMESPACES = Path("/var/run/netns")
_TUN = Path("/dev/net/tun")
_IPV6 = Path("/proc/sys/net/ipv6")
_OWN_NAME = re.compile(r"relod-(\d+)-(?:local|remote)")
_COMMAND_TIMEOUT_S = 10.0


class NamespaceHosts(ABC):
    """Each host is a network namespace of its own; what joins them is the subclasses' business.

    The hosts reach each other and themselves, and nothing else: whoever wants to talk to their services has
    to be started with ``command_prefix`` too. One launcher can hold one such link at a time.
    """

    addresses: ClassVar[Mapping[Host, str]] = {"local": "10.213.77.1", "remote": "10.213.77.2"}
    """Address of each host. The same in every run: namespaces do not see each other."""

    def __init__(self, conditions: NetworkConditions) -> None:
        self._conditions = conditions
        self._created: list[str] = []
        self._final_bytes: dict[Direction, int] | None = None

    def __enter__(self) -> Self:
        remove_stale_namespaces()
        try:
            for host in HOSTS:
                self._create(host)
            self._join()
        except BaseException:
            self._remove()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            # A link that failed may have lost its devices; that must not hide why the run ends.
            with contextlib.suppress(LinkFailedError):
                self._final_bytes = self.kernel_bytes()
        finally:
            self._remove()

    def listen_address(self, host: Host) -> str:
        return self.addresses[host]

    def dial_address(self, from_host: Host, to_host: Host, port: int) -> tuple[str, int]:
        return self.addresses[to_host], port

    def command_prefix(self, host: Host) -> list[str]:
        return ["ip", "netns", "exec", namespace_name(host)]

    def kernel_bytes(self) -> dict[Direction, int] | None:
        if not self._created:
            return self._final_bytes
        return {"uplink": self._sent_bytes("local"), "downlink": self._sent_bytes("remote")}

    @abstractmethod
    def _join(self) -> None:
        """Join the two namespaces; each needs a device :data:`DEVICE`."""

    @abstractmethod
    def _stop(self) -> None:
        """End what joins them; harmless if it was never begun."""

    def _sent_bytes(self, host: Host) -> int:
        """Bytes of IP packets that the host has sent into the link."""
        return int(device_statistics(host)["tx"]["bytes"])

    def _create(self, host: Host) -> None:
        name = namespace_name(host)
        if (_NAMESPACES / name).exists():
            raise LinkUnavailable(
                f"the network namespace {name} exists already: this launcher has another link open, "
                f"or else remove it with: ip netns delete {name}"
            )
        self._created.append(name)  # first: an interrupted command may have made it all the same
        run_command("ip", "netns", "add", name)
        run_command("ip", "-n", name, "link", "set", "lo", "up")
        self._choose_congestion_control(host)

    def _choose_congestion_control(self, host: Host) -> None:
        name = self._conditions.congestion_control
        if not name:
            return
        directory = "/proc/sys/net/ipv4"
        inside = (*self.command_prefix(host), "sh", "-c")
        try:
            run_command(*inside, f"echo {name} > {directory}/tcp_congestion_control")
        except LinkUnavailable as error:
            allowed = run_command(*inside, f"cat {directory}/tcp_allowed_congestion_control").split()
            raise ConfigError(
                f"network.congestion_control = {name!r}: this kernel allows a namespace {', '.join(allowed)}"
            ) from error

    def _set_up(self, host: Host) -> None:
        """Give the host's device its address."""
        name = namespace_name(host)
        other: Host = "remote" if host == "local" else "local"
        run_command("ip", "-n", name, "link", "set", DEVICE, "mtu", str(MTU_BYTES))
        if _IPV6.exists():
            # Without an IPv6 address the host sends nothing of its own accord: every byte counted is a service's.
            run_command("ip", "-n", name, "link", "set", DEVICE, "addrgenmode", "none")
        address = ("addr", "add", self.addresses[host], "peer", self.addresses[other])
        run_command("ip", "-n", name, *address, "dev", DEVICE)
        run_command("ip", "-n", name, "link", "set", DEVICE, "up")

    def _remove(self) -> None:
        try:
            self._stop()
        finally:
            while self._created:
                _delete(self._created.pop())


class NamespaceLink(NamespaceHosts):
    """The hosts are joined by a process that carries their packets, :mod:`deploy.network.tun`."""

    def __init__(self, conditions: NetworkConditions, run_dir: Path, seed: int = 0) -> None:
        super().__init__(conditions)
        self._process = LinkProcess("deploy.network.tun", conditions, run_dir, seed)

    def __enter__(self) -> Self:
        require_namespaces()
        require_tun()
        return super().__enter__()

    def part(self) -> NetworkPart:
        return self._process.part()

    def failure(self) -> str | None:
        return self._process.failure()

    def over(self) -> str | None:
        return self._process.over()

    def _join(self) -> None:
        for host in HOSTS:
            run_command("ip", "-n", namespace_name(host), "tuntap", "add", "dev", DEVICE, "mode", "tun")
            self._set_up(host)
        self._process.start(
            [
                *("--local", str(_NAMESPACES / namespace_name("local"))),
                *("--remote", str(_NAMESPACES / namespace_name("remote"))),
                *("--device", DEVICE),
            ]
        )

    def _stop(self) -> None:
        self._process.stop()


def namespace_name(host: Host) -> str:
    """Name of this process's namespace for ``host``."""
    return f"relod-{os.getpid()}-{host}"


def require_namespaces() -> None:
    """Raise :class:`LinkUnavailable` if this process cannot make network namespaces."""
    if shutil.which("ip") is None:
        raise LinkUnavailable("network namespaces need the command 'ip': install iproute2")
    if os.geteuid() != 0:
        raise LinkUnavailable("network namespaces need root: run the launcher with sudo, or choose the relay")


def require_tun() -> None:
    """Raise :class:`LinkUnavailable` if there are no TUN devices."""
    if not _TUN.exists():
        raise LinkUnavailable(
            f"the packet link needs {_TUN}: load the kernel module 'tun', or start the container with "
            "--device /dev/net/tun --cap-add NET_ADMIN --cap-add SYS_ADMIN"
        )


def remove_stale_namespaces() -> list[str]:
    """Remove the namespaces of launchers that died before they could; returns their names."""
    names = [path.name for path in sorted(_NAMESPACES.glob("relod-*"))]
    stale = [name for name in names if (found := _OWN_NAME.fullmatch(name)) and not _alive(int(found[1]))]
    for name in stale:
        _log.info("removing the network namespace %s of a launcher that has died", name)
        _delete(name)
    return stale


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _delete(name: str) -> None:
    try:
        run_command("ip", "netns", "delete", name)
    except LinkUnavailable as error:
        if (_NAMESPACES / name).exists():  # else another launcher has been faster with a stale one
            _log.warning("%s", error)


def device_statistics(host: Host) -> dict[str, Any]:
    """The kernel's counters of the host's device: ``tx`` and ``rx``, each with ``bytes`` and ``packets``."""
    try:
        text = run_command("ip", "-n", namespace_name(host), "-s", "-j", "link", "show", "dev", DEVICE)
    except LinkUnavailable as error:
        raise LinkFailedError(f"the kernel's counters of {host} cannot be read: {error}") from error
    statistics: dict[str, Any] = json.loads(text)[0]["stats64"]
    return statistics


def run_command(*command: str) -> str:
    """Run a command of iproute2 and return what it printed; :class:`LinkUnavailable` if it fails."""
    try:
        # A session of its own: Ctrl-C must not interrupt the removal of what has been created.
        finished = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=_COMMAND_TIMEOUT_S,
            start_new_session=True,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise LinkUnavailable(f"{' '.join(command)}: {error}") from error
    if finished.returncode != 0:
        reason = finished.stderr.strip() or f"exit code {finished.returncode}"
        hint = "; it takes CAP_SYS_ADMIN and CAP_NET_ADMIN" if "not permitted" in reason else ""
        raise LinkUnavailable(f"{' '.join(command)}: {reason}{hint}")
    return finished.stdout
