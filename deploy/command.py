"""``python -m deploy.command FILE COMMAND``: tell a running service what to do, or stop its robot.

FILE is the service's configuration, such as ``RUN_DIR/config/robot_bridge.toml``: it says whom to ask, and where.
"""

from __future__ import annotations

import argparse
import socket
import sys
import time
from pathlib import Path

from common.codec import decode, encode
from common.config import build_config, read_toml
from common.errors import ConfigError, RelodError
from common.messages import Command, CommandReply
from common.run_settings import RunSettings, TransportSettings
from common.topics import SERVICES, command_topic
from common.transport import ZenohTransport
from deploy.plan import CONFIG_CLASSES

COMMANDS = {
    "e_stop": "stop the robot; it stays stopped, even if the bridge is started anew (robot_bridge)",
    "pause": "stop the robot until `resume` (robot_bridge)",
    "resume": "let the robot go on (robot_bridge)",
    "checkpoint": "save policy and learner state now (learner)",
    "stop": "end the service; of robot_bridge: end the run",
}
_ANSWER_WITHIN_S = 5.0


def main(arguments: list[str] | None = None) -> int:
    """Send one command and print the answer; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m deploy.command",
        description="Tell a running service what to do.",
        epilog="\n".join(f"  {name:12}{text}" for name, text in COMMANDS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="the service's configuration, NAME.toml")
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help="one of the commands below")
    options = parser.parse_args(arguments)
    try:
        reply = send(options.file, options.command)
    except RelodError as error:
        print(f"deploy.command: error: {error}", file=sys.stderr)
        return 1
    print(reply.detail, file=sys.stdout if reply.accepted else sys.stderr)
    return 0 if reply.accepted else 1


def send(file: Path, command: str) -> CommandReply:
    """Send ``command`` to the service that ``file`` configures and return its answer.

    Raises:
        ConfigError: the file is no service's configuration, or nobody answers where it says.
    """
    service = file.stem
    if service not in SERVICES:
        raise ConfigError(f"{file}: expected the configuration of a service, one of {', '.join(SERVICES)}.toml")
    config = build_config(CONFIG_CLASSES[service], read_toml(file), str(file))
    run: RunSettings = config.run
    peer: TransportSettings = config.transport
    address = peer.listen_real_time.removeprefix("tcp/").rpartition(":")[0]
    watcher = TransportSettings(
        listen_real_time=f"tcp/{address}:{_free_port(address)}",
        listen_bulk=f"tcp/{address}:{_free_port(address)}",
        connect_real_time=[peer.listen_real_time],
    )
    transport = ZenohTransport(run, watcher)
    try:
        end_s = time.monotonic() + _ANSWER_WITHIN_S
        while time.monotonic() < end_s:
            payload = transport.query(command_topic(service), encode(Command(command)))
            if payload is not None:
                return decode(payload, CommandReply)
            time.sleep(0.1)  # nobody there answers at once: the connection may still be coming
    finally:
        transport.close()
    raise ConfigError(f"no {service} of run {run.id} answers on {peer.listen_real_time}; is it running?")


def _free_port(address: str) -> int:
    try:
        with socket.socket() as probe:
            probe.bind((address, 0))
            port: int = probe.getsockname()[1]
            return port
    except OSError as error:
        raise ConfigError(
            f"{address} is not this computer's address: run this on the service's computer ({error.strerror})"
        ) from error


if __name__ == "__main__":
    sys.exit(main())
