"""A service's process: command line, logging, signals, exit code."""

from __future__ import annotations

import argparse
import gc
import logging
import logging.handlers
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import tomli_w

from common.clock import Clock, SkewedClock, SystemClock
from common.config import load_config, to_tables
from common.errors import RelodError, ServiceError
from common.record import write_atomically
from common.run_settings import ClockSettings
from common.service import Service
from common.transport import ZenohTransport

Config = TypeVar("Config")
logger = logging.getLogger(__name__)

_STARTING_S = 1.0
"""A service that is asked to stop while it starts has this long to notice by itself."""


def run_service(
    name: str,
    config_class: type[Config],
    serve: Callable[[Service, Config], None],
    arguments: Sequence[str] | None = None,
    description: str | None = None,
) -> int:
    """Run one service from its command line until it has ended; return the process's exit code."""
    parser = argparse.ArgumentParser(
        prog=f"python -m services.{name}",
        description=description,
        epilog="`python -m deploy.launch MODE --task TASK --write-config DIR` writes a configuration for each service.",
    )
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="this service's TOML file")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="override a setting; may be given several times",
    )
    options = parser.parse_args(arguments)
    try:
        config: Any = load_config(config_class, options.config, options.set)
        listener = _start_logging(Path(config.run.directory), name)
    except RelodError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        return 1
    try:
        return _run(name, config, serve)
    except RelodError as error:
        logger.error("%s", error)
        return 1
    finally:
        listener.stop()
        logging.shutdown()


def end_process(exit_code: int) -> NoReturn:
    """End at once: torch takes seconds to be torn down, and a session in a dead network for ever."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(exit_code)


def _run(name: str, config: Any, serve: Callable[[Service, Any], None]) -> int:
    # The interpreter's default of 5 ms is how long a computing thread may keep a waiting real-time thread out.
    sys.setswitchinterval(5e-4)
    service = Service(name, config.run, ZenohTransport(config.run, config.transport), _clock(config.clock))
    _stop_on_signals(service)
    _keep_configuration(name, config)
    logger.info("%s starts: run %s, process %d", name, config.run.id, os.getpid())
    endpoints = config.transport
    dialled = [*endpoints.connect_real_time, *endpoints.connect_bulk]
    logger.info(
        "listens on %s and %s, connects to %s",
        endpoints.listen_real_time,
        endpoints.listen_bulk,
        ", ".join(dialled) or "nobody",
    )
    try:
        service.start()
        gc.freeze()
        serve(service, config)
    except RelodError as error:
        service.failure = str(error)
        raise
    except Exception as error:
        service.failure = f"{type(error).__name__}: {error}"
        logger.exception("unexpected error")
        raise ServiceError(f"unexpected {type(error).__name__}: {error}; see the log") from error
    finally:
        service.close()
        logger.info("%s has ended", name)
    if service.failure:
        raise ServiceError(service.failure)
    if service.record.part_error:
        raise ServiceError(f"the end of this service is not in the run's record: {service.record.part_error}")
    return 0


def _clock(settings: ClockSettings) -> Clock:
    if settings == ClockSettings():
        return SystemClock()
    logger.warning("[clock]: not this computer's clock but one that is off by %s", settings)
    return SkewedClock(SystemClock(), settings.offset_s, settings.drift_ppm)


def _keep_configuration(name: str, config: Any) -> None:
    """Leave the resolved configuration in the run's record, however the service was started."""
    path = Path(config.run.directory) / "config" / f"{name}.toml"
    try:
        write_atomically(path, tomli_w.dumps(to_tables(config)))
    except OSError as error:
        logger.error("%s: cannot be written: %s", path, error.strerror)


def _stop_on_signals(service: Service) -> None:
    # A handler interrupts the main thread, which may hold the very lock that stopping takes: a thread can wait for it.
    def handle(number: int, _: object) -> None:
        threading.Thread(target=stop, args=(signal.Signals(number).name,), daemon=True).start()

    def stop(reason: str) -> None:
        service.stop(reason)
        time.sleep(_STARTING_S)
        if service.state == "starting":
            # It is still importing, for seconds more; there is nothing to hand over yet.
            service.close()
            end_process(0)

    # A service started in the background by a script inherits ignored signals: install handlers explicitly.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, handle)


def _start_logging(directory: Path, name: str) -> logging.handlers.QueueListener:
    """Log to ``RUN_DIR/logs/NAME.log`` and to the terminal, from a thread of its own."""
    try:
        (directory / "logs").mkdir(parents=True, exist_ok=True)
        file = logging.FileHandler(directory / "logs" / f"{name}.log", encoding="utf-8")
    except OSError as error:
        raise ServiceError(f"{directory}: the run's folder cannot be written: {error.strerror}") from error
    formatter = logging.Formatter(f"%(asctime)s.%(msecs)03d {name} %(levelname)s %(message)s", "%H:%M:%S")
    terminal = logging.StreamHandler()
    for handler in (file, terminal):
        handler.setFormatter(formatter)
    entries: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
    listener = logging.handlers.QueueListener(entries, file, terminal)
    listener.start()
    root = logging.getLogger()
    root.handlers = [logging.handlers.QueueHandler(entries)]
    root.setLevel(logging.INFO)
    return listener
