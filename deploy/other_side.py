"""The launcher on the other computer: whether it starts the same run, how that goes there, and its part of the record.

Each side asks the other for its news, over a Zenoh session of the launchers' own; the computer ``remote`` connects to
``local``. A question and an answer both carry the news of who sends them::

    {"ask": "news", "news": {...}}                                   ->   {"news": {...}}
    {"ask": "file", "name": ..., "offset": ..., "news": {...}}       ->   the launcher's name, then the file's bytes
"""

from __future__ import annotations

import json
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from common.errors import MessageError
from common.topics import Delivery, Lane, Topic
from common.transport import Transport
from deploy.agreement import Facts
from deploy.mirror import HOSTS_FOLDER, Mirror, read_piece, shared_files
from deploy.network import Host

LAUNCHERS_RUN = "launchers"
"""Second part of the launchers' keys, where services have their run's id: the sides have yet to agree on one."""
POLL_S = 1.0
"""Period of the questions: that of the parts."""
_ANSWER_WITHIN_S = 2.0

WAITING, RUNNING, ENDED = "waiting", "running", "ended"


@dataclass(frozen=True)
class News:
    """What one side tells the other."""

    launcher: str = ""
    """Which launcher this is, of all that were ever started there."""
    agreed_with: str = ""
    """The other side's launcher, once a run has been agreed on."""
    facts: Facts = field(default_factory=dict)
    """What both have to agree on; see :mod:`deploy.agreement`."""
    phase: str = WAITING
    """``waiting`` for the other, ``running``, or ``ended``: then the files are final."""
    outcome: str = ""
    """How it has ended, in words."""
    succeeded: bool = False
    """Whether it has ended as it should."""
    said: list[str] = field(default_factory=list)
    """What this side has said of its services, from the beginning."""
    restart: list[str] = field(default_factory=list)
    """Commands that start this side's services again."""
    has_record: bool = False
    """It has the other side's whole record."""
    files: dict[str, int] = field(default_factory=dict)
    """Shared files of its record, name -> bytes."""


def launcher_topic(host: Host) -> Topic:
    """Return the query that the launcher on ``host`` answers."""
    return Topic(f"launcher/{host}", News, (), (), Delivery.QUERY, Lane.REAL_TIME, "1 s")


class OtherSide:
    """What is known of the other side; a thread asks for it while entered."""

    def __init__(
        self, transport: Transport, here: Host, there: Host, run_dir: Path, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self.here, self.there = here, there
        self.mirror = Mirror(run_dir / HOSTS_FOLDER / there, self._fetch)
        self._transport, self._run_dir, self._now_s = transport, run_dir, now_s
        self._lock = threading.Lock()
        self._mine = News(launcher=secrets.token_hex(8))
        self._theirs: News | None = None
        self._heard_s = now_s()
        self._tells_files = False
        self._stopping = threading.Event()
        self._asks = threading.Event()
        self._thread = threading.Thread(target=self._run, name="other side", daemon=True)

    def start(self) -> None:
        """Answer the other side's questions, and ask it."""
        self._transport.serve(launcher_topic(self.here), self._answer)
        self._thread.start()

    def close(self) -> None:
        """Tell the last news once more, then stop."""
        self._stopping.set()
        self._asks.set()
        self._thread.join(_ANSWER_WITHIN_S + 1.0)
        self._transport.close()

    @property
    def news(self) -> News | None:
        """The newest that was heard; None before the first."""
        with self._lock:
            return self._theirs

    @property
    def has_record(self) -> bool:
        """True once the other side's whole record is in the mirror."""
        with self._lock:
            return self._mine.has_record

    @property
    def silent_s(self) -> float:
        """Seconds since something was heard."""
        with self._lock:
            return self._now_s() - self._heard_s

    def tell(self, **changes: Any) -> None:
        """Change what this side tells, and let the other know."""
        with self._lock:
            self._mine = News(**{**_plain(self._mine), **changes})
        self._asks.set()

    def agree(self, **changes: Any) -> None:
        """From now on listen to the launcher that was heard last, and to no other."""
        news = self.news
        assert news is not None
        self.tell(agreed_with=news.launcher, **changes)

    def is_taken(self, news: News) -> bool:
        """True if that launcher has agreed on a run with another launcher than this one."""
        with self._lock:
            return news.agreed_with not in ("", self._mine.launcher)

    def say(self, text: str) -> None:
        """Let the other side repeat to its user what happened here."""
        with self._lock:
            said = [*self._mine.said, text]
        self.tell(said=said)

    def share_files(self) -> None:
        """From now on the run directory is this run's: tell what is in it."""
        self._tells_files = True

    def _told(self) -> dict[str, Any]:
        files = shared_files(self._run_dir) if self._tells_files else {}
        with self._lock:
            return {**_plain(self._mine), "files": files}

    def _answer(self, payload: bytes) -> bytes:
        try:
            question = json.loads(payload)
            self._hear(news_from(question["news"]))
            if question["ask"] == "file":
                piece = read_piece(self._run_dir, str(question["name"]), int(question["offset"]))
                return self._mine.launcher.encode() + piece
        except (ValueError, KeyError, TypeError, MessageError):
            pass  # whoever asks that is no launcher of this release; who we are it may know
        return json.dumps({"news": self._told()}).encode()

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._ask()
            self._asks.wait(POLL_S)
            self._asks.clear()
        self._ask()

    def _ask(self) -> None:
        payload = self._query("news")
        if payload is None:
            return
        try:
            self._hear(news_from(json.loads(payload)["news"]))
        except (ValueError, KeyError, TypeError, MessageError):
            return
        news = self.news
        if news is None:
            return
        with self._lock:
            complete, is_ours = self._mine.has_record, self._mine.agreed_with == news.launcher
        if is_ours and not (complete or self._stopping.is_set()):
            ended = news.phase == ENDED
            if self.mirror.update(news.files, whole=ended) and ended:
                self.tell(has_record=True)

    def _query(self, ask: str, **what: Any) -> bytes | None:
        question = {"ask": ask, **what, "news": self._told()}
        return self._transport.query(launcher_topic(self.there), json.dumps(question).encode(), _ANSWER_WITHIN_S)

    def _fetch(self, name: str, offset: int) -> bytes | None:
        news, answer = self.news, self._query("file", name=name, offset=offset)
        if news is None or answer is None:
            return None
        # After that launcher was killed another one may answer, whose run directory has no files of this run.
        owner = news.launcher.encode()
        return answer[len(owner) :] if answer.startswith(owner) else None

    def _hear(self, news: News) -> None:
        with self._lock:
            if self._mine.agreed_with in ("", news.launcher):
                self._theirs, self._heard_s = news, self._now_s()


def news_from(values: Any) -> News:
    """Return news as they came from the other side.

    Raises:
        MessageError: they are no news.
    """
    expected = {"facts": dict, "said": list, "restart": list, "files": dict, "succeeded": bool, "has_record": bool}
    if not isinstance(values, Mapping):
        raise MessageError(f"expected a launcher's news, got {type(values).__name__}")
    known = {}
    for item in fields(News):
        value = values.get(item.name)
        if not isinstance(value, expected.get(item.name, str)):
            raise MessageError(f"a launcher's news: {item.name} = {value!r}: expected {expected.get(item.name, str)}")
        known[item.name] = value
    texts = [*known["facts"].values(), *known["said"], *known["restart"]]
    sizes = known["files"].values()
    if not all(isinstance(text, str) for text in texts) or not all(type(size) is int for size in sizes):
        raise MessageError("a launcher's news: expected texts and sizes")
    return News(**known)


def _plain(news: News) -> dict[str, Any]:
    return asdict(news)
