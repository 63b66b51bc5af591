"""Reads a live run knowing nothing but ``docs/wire-format.md``, and holds it to every word there.

Run outside the repository, beside the document and the files that stand in it (``client.py``, ``observation.py``,
``policy.py``), with nothing importable but zenoh, msgpack, NumPy, xxhash and zstd::

    python wire_listener.py DOCUMENT RUN ROBOT ENDPOINT ...

It listens until it has heard enough, stops the run by a command, and prints what it found as JSON.
"""

from __future__ import annotations

import importlib.util
import json
import math
import queue
import re
import sys
import time
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

LIMIT_S = 100.0
"""Longest time for the services to start and to be heard enough of."""
ENOUGH = {
    "timestep": 200,
    "action": 100,
    "experience": 200,
    "timestep/head": 3,
    "timestep/ack": 3,
    "experience/head": 3,
    "experience/ack": 3,
    "credit": 3,
    "minibatch/arrays": 20,
    "policy": 5,
    "policy/ack": 3,
    "status": 20,
}
"""Messages to hear on each topic."""
ACTIONS_OF_PUSHED_POLICIES = 60
"""Actions to hear of policies that were heard too."""
SERVICES = ("robot_bridge", "actor", "replay", "learner")
DTYPES = {"uint8": "|u1", "int64": "<i8", "float32": "<f4"}


# ------------------------------------------------------------------ the document


def table_rows(document, title):
    """Rows, as dicts, of the first table after a line that contains ``title``."""
    _, found, after = document.partition(title)
    assert found, f"the document has no {title!r}"
    lines = re.search(r"^\|.*\n\|[ -|]+\n(?:\|.*\n)+", after, re.MULTILINE)[0].splitlines()
    cells = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    return [dict(zip(cells[0], row, strict=True)) for row in cells[2:]]


def plain(cell):
    """Text of a cell without its Markdown."""
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", cell).replace("`", "")


class Tables:
    """What the document's tables say of topics and messages."""

    def __init__(self, document):
        self.topics = {plain(row["topic"]): row for row in table_rows(document, "<!-- table: topics -->")}
        enumerations = ("ActionSource", "FrameEncoding")
        self.values = {
            f"str {name}": [plain(row["value"]) for row in table_rows(document, f"#### {name}\n")]
            for name in enumerations
        }
        start, end = document.index("<!-- table: messages -->"), document.index("<!-- table: action sources -->")
        names = re.findall(r"^#### (\w+)$", document[start:end], re.MULTILINE)
        self.messages = {
            name: {plain(row["field"]): row for row in table_rows(document, f"#### {name}\n")} for name in names
        }

    def check(self, message, fields, sizes):
        """Fail unless ``fields`` are those of ``message``; ``sizes`` are those that letters stand for so far."""
        rows = self.messages[message]
        assert set(fields) == set(rows), f"{message}: {set(fields) ^ set(rows)}"
        for name, value in fields.items():
            kind, bounds = plain(rows[name]["on the wire"]), rows[name]["bounds"]
            self._check(f"{message}.{name}", kind, bounds, value, sizes)

    def _check(self, where, kind, bounds, value, sizes):
        # What the client reads is pixels, encoded or not.
        kind = kind.removesuffix(" or encoded")
        if match := re.fullmatch(r"(\w+) \((.*)\)", kind):
            self._check_array(where, match[1], match[2].split(", "), bounds, value, sizes)
        elif kind.endswith(" or nil"):
            if value is not None:
                self._check(where, kind.removesuffix(" or nil"), bounds, value, sizes)
        elif match := re.fullmatch("map of str to (.*)", kind):
            assert all(isinstance(key, str) for key in value), where
            for key, item in value.items():
                self._check(f"{where}[{key}]", match[1], bounds, item, sizes)
        elif match := re.fullmatch("list of (.*)", kind):
            assert isinstance(value, list), where
            for item in value:
                self._check(where, match[1], bounds, item, sizes)
        elif match := re.fullmatch(r"map (\w+)", kind):
            self.check(match[1], value, sizes)
        elif kind in self.values:
            assert value in self.values[kind], f"{where}: {value}"
        else:
            wanted = {"int": int, "float": float, "bool": bool, "str": str}[kind]
            assert type(value) is wanted, f"{where}: expected {kind}, got {value!r}"
            self._check_bounds(where, bounds, value)

    @staticmethod
    def _check_array(where, dtype, shape, bounds, value, sizes):
        assert isinstance(value, np.ndarray), f"{where}: {value!r}"
        assert value.dtype.str == DTYPES[dtype], f"{where}: {value.dtype.str}"
        assert len(shape) == value.ndim, f"{where}: {value.shape}, not {shape}"
        pairs = zip(shape, value.shape, strict=True)
        expected = [int(n) if n.isdigit() else sizes.setdefault(n, size) for n, size in pairs]
        assert list(value.shape) == expected, f"{where}: {value.shape}, not {expected}"
        assert bounds == ("finite" if dtype.startswith("float") else ""), f"{where}: {bounds}"
        assert np.isfinite(value).all(), where

    @staticmethod
    def _check_bounds(where, bounds, value):
        if isinstance(value, float):
            assert math.isfinite(value), where
        for bound in bounds.split(", ") if bounds and bounds != "finite" else []:
            sign, number = bound.split(" ")
            limit = 2**62 if number == "2^62" else float(number)
            assert value >= limit if sign == "≥" else value <= limit, f"{where}: {value} is not {bound}"


# ------------------------------------------------------------------ listening


class Listener:
    """Hears everything of one run and checks it against the document's tables as it comes."""

    def __init__(self, client, tables, session, root):
        self._client, self._tables, self._root = client, tables, root
        self._arrived = queue.SimpleQueue()
        self.heard = defaultdict(list)
        self.sent_as = {}
        self.sizes = {}
        self._subscriber = session.declare_subscriber(f"{root}/**", self._arrived.put)

    def take(self, timeout_s):
        """Take one message."""
        sample = self._arrived.get(timeout=timeout_s)
        topic = str(sample.key_expr).removeprefix(f"{self._root}/")
        row = self._tables.topics[topic]
        fields = self._client.decode(sample.payload.to_bytes(), plain(row["message"]))
        self._tables.check(plain(row["message"]), fields, dict(self.sizes))
        flags = f"{sample.priority} {sample.congestion_control}{' express' if sample.express else ''}"
        self.sent_as[topic] = re.sub(r"\w+\.", "", flags)
        assert self.sent_as[topic] == plain(row["sent as"]), f"{topic}: {flags}"
        self.heard[topic].append(fields)
        return topic, fields

    def until(self, condition, what):
        """Take messages until ``condition(topic, fields)`` holds."""
        end = time.monotonic() + LIMIT_S
        while True:
            try:
                topic, fields = self.take(max(0.0, end - time.monotonic()))
            except queue.Empty:
                counts = {topic: len(messages) for topic, messages in self.heard.items()}
                raise AssertionError(f"not within {LIMIT_S:.0f} s: {what}; heard {counts}") from None
            if condition(topic, fields):
                return

    def enough(self, *_):
        """True once every topic of :data:`ENOUGH` and every service at work has been heard."""
        running = {status["service"] for status in self.heard["status"] if status["state"] == "running"}
        versions = {weights["version"] for weights in self.heard["policy"]}
        learnt = sum(action["policy_version"] in versions for action in self.heard["action"])
        heard = all(len(self.heard[topic]) >= n for topic, n in ENOUGH.items())
        return heard and running == set(SERVICES) and learnt >= ACTIONS_OF_PUSHED_POLICIES


# ------------------------------------------------------------------ what must hold


def by_number(messages, name="seq"):
    """Number -> message; one that came twice must be the same."""
    found = {}
    for message in messages:
        known = found.setdefault(message[name], message)
        assert same(known, message), f"{name} {message[name]} came with different contents"
    return dict(sorted(found.items()))


def same(one, other):
    """True if two decoded values are equal, types and arrays included."""
    if type(one) is not type(other):
        return False
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    return np.array_equal(one, other) if isinstance(one, np.ndarray) else one == other


def carried_id(frame):
    """The id that a frame of `noise_frames` carries."""
    return int.from_bytes(frame.tobytes()[:8], "little")


def check_time_steps(steps, spec):
    """Numbers, frames and values of the time steps; return how many consecutive pairs were compared."""
    pairs = 0
    for seq, step in steps.items():
        assert step["frames"].shape[1:] == tuple(spec["frame_shape"]), step["frames"].shape
        assert [carried_id(frame) for frame in step["frames"]] == step["frame_ids"].tolist()
        assert np.array_equal(step["proprioception"], step["action"])
        assert np.array_equal(step["action"], np.clip(step["action"], spec["action_low"], spec["action_high"]))
        assert not (step["terminated"] and step["truncated"])
        first = step["step_index"] == 0
        assert (step["action_source"] == "none") == first
        assert step["reward"] == (0.0 if first else -1.0)
        assert (step["answered_seq"] >= 0) == (step["action_source"] in ("policy", "held"))
        if first:
            assert not step["action"].any()
            assert step["action_applied_ns"] == 0
        before = steps.get(seq - 1)
        if before is None:
            continue
        pairs += 1
        assert step["frame_ids"].tolist() == list(range(before["frame_ids"][-1] + 1, step["frame_ids"][-1] + 1))
        assert step["published_ns"] > before["published_ns"]
        assert step["attempt"] == before["attempt"] + first
        assert first or step["step_index"] == before["step_index"] + 1
        assert first or not (before["terminated"] or before["truncated"])
        assert step["acted_steps"] == before["acted_steps"] + (not first)
        resets = spec["reset_steps"] if before["truncated"] else 0
        assert step["steps"] - before["steps"] == (resets if first else 1)
        assert step["episode"] == before["episode"] + before["terminated"]
    return pairs


def check_actions(steps, actions, spec):
    """Return how many time steps were compared with the actions that they name."""
    compared = 0
    for step in steps.values():
        if step["answered_seq"] in actions:
            chosen = actions[step["answered_seq"]]["action"]
            assert np.array_equal(np.clip(chosen, spec["action_low"], spec["action_high"]), step["action"])
            compared += 1
    return compared


def check_times(steps, actions):
    """Times are in order on each clock and, by the offset, on both; return how often, and the newest offset."""
    for action in actions.values():
        assert 0 < action["received_ns"] <= action["began_ns"] <= action["sent_ns"]
    compared = 0
    for step in steps.values():
        action = actions.get(step["answered_seq"])
        observed = steps.get(step["answered_seq"])
        if action is None or observed is None or action["offset_bound_ns"] < 0:
            continue
        compared += 1
        bound = action["offset_bound_ns"]
        received, sent = (action[name] + action["offset_ns"] for name in ("received_ns", "sent_ns"))
        assert observed["published_ns"] <= received + bound
        assert sent - bound <= step["action_applied_ns"]
    newest = actions[max(actions)]
    return compared, newest["offset_ns"], newest["offset_bound_ns"]


def check_experiences(experiences, steps, actions):
    """Return how many experiences were compared with their time steps, and how many with their actions."""
    compared = answered = 0
    for experience in experiences.values():
        step, extras = experience["time_step"], experience["extras"]
        if step["step_index"] == 0:
            assert extras is None
        if step["seq"] in steps:
            assert same(step, steps[step["seq"]])
            compared += 1
        if extras and step["seq"] - 1 in actions:
            action = actions[step["seq"] - 1]
            assert np.array_equal(extras["chosen_action"], action["action"])
            for name in ("log_probability", "policy_version"):
                assert extras[name] == action[name]
            answered += 1
    return compared, answered


def rebuilt_stacks(steps, size, observation):
    """seq -> (frame ids, stack), by the document's rule, wherever no time step before it is missing."""
    stacks, found, last = None, {}, None
    for seq, step in steps.items():
        if last is None or seq != last + 1:
            stacks = observation.FrameStacks(size)
        last = seq
        if stack := stacks.add(step):
            found[seq] = stack
    return found


def check_log_probabilities(steps, stacks, actions, pushed, spec, policy):
    """Recompute the density of what the actor chose; return how often each way: initial policy, pushed policy."""
    compared = Counter()
    weights = {message["version"]: (policy.parameters(message), message) for message in pushed}
    for seq, action in actions.items():
        unit = policy.to_unit(action["action"], spec["action_low"], spec["action_high"])
        version = action["policy_version"]
        if seq not in stacks or (abs(unit) > 0.99).any() or (version and version not in weights):
            continue
        mean, log_std = np.zeros(len(unit)), np.zeros(len(unit))
        if version:
            step = steps[seq]
            mean, log_std = policy.distribution(
                *weights[version], spec, stacks[seq][1], step["proprioception"], step["action"]
            )
        noise = (np.arctanh(unit) - mean) / np.exp(log_std)
        again, log_probability = policy.act(mean, log_std, spec, noise)
        assert np.allclose(again, action["action"], atol=1e-4)
        assert abs(log_probability - action["log_probability"]) < 0.01, (version, log_probability, action)
        compared["pushed" if version else "initial"] += 1
    return compared


def check_minibatches(messages, steps, stacks):
    """Assemble minibatches from their parts; return how many transitions were found among the time steps heard."""
    newest = {int(step["frame_ids"][-1]): seq for seq, step in steps.items()}
    compared, parts = 0, []
    for message in messages:
        if message["part"] != len(parts) or (parts and message["ordinal"] != parts[0]["ordinal"]):
            parts = []
        if message["part"] == len(parts):
            parts.append(message)
        if len(parts) < message["parts"]:
            continue
        frames, parts = np.concatenate([part["frames"] for part in parts]), []
        ids = np.array([carried_id(frame) for frame in frames])
        assert len(set(ids.tolist())) == len(ids), "each frame once"
        for row, next_stack in enumerate(ids[message["next_frame_index"]].tolist()):
            seq = newest.get(next_stack[-1])
            if seq is None or seq - 1 not in steps or seq not in stacks or seq - 1 not in stacks:
                continue
            stack = ids[message["frame_index"][row]].tolist()
            assert (stack, next_stack) == (stacks[seq - 1][0], stacks[seq][0])
            x, y = steps[seq - 1], steps[seq]
            assert y["attempt"] == x["attempt"]
            assert y["action_source"] != "stop"
            wanted = {
                "proprioception": x["proprioception"],
                "previous_action": x["action"],
                "action": y["action"],
                "next_proprioception": y["proprioception"],
                "reward": np.float32(y["reward"]),
                "terminated": np.uint8(y["terminated"]),
            }
            for name, value in wanted.items():
                assert np.array_equal(message[name][row], value), name
            compared += 1
    return compared


def check_stream(heads, acknowledgements, stream):
    """Heads and acknowledgements of one stream go forward and never beyond what there is."""
    for message in [*heads, *acknowledgements]:
        assert message["stream"] == stream
    for messages, names in ((heads, ("oldest_seq", "next_seq")), (acknowledgements, ("next_seq",))):
        for name in names:
            numbers = [message[name] for message in messages]
            assert numbers == sorted(numbers), f"{name} goes back"
    assert all(head["oldest_seq"] <= head["next_seq"] for head in heads)
    for acknowledgement in acknowledgements:
        ranges = acknowledgement["missing"].tolist()
        assert all(start < end for start, end in ranges)


def check_statuses(statuses, run, robot):
    """Return service -> incarnation; everybody knows everybody in the end."""
    incarnations = {status["service"]: status["incarnation"] for status in statuses}
    for status in statuses:
        assert (status["run"], status["robot"]) == (run, robot)
        assert status["state"] in ("starting", "running", "draining", "drained", "stopped")
        assert status["incarnation"] == incarnations[status["service"]]
        assert status["peers"].items() <= incarnations.items()
    for service in SERVICES:
        known = [status["peers"] for status in statuses if status["service"] == service][-1]
        assert set(known) == set(SERVICES) - {service}
    return incarnations


def main(document_file, run, robot, *endpoints):
    for name in ("common", "services", "deploy", "experiments", "benchmarks", "tests", "relod"):
        assert importlib.util.find_spec(name) is None, f"{name} can be imported: this shows nothing"
    client, observation, policy = (importlib.import_module(name) for name in ("client", "observation", "policy"))
    tables = Tables(Path(document_file).read_text(encoding="utf-8"))
    root = f"relod/{run}/{robot}"
    with client.open_session(list(endpoints)) as session:
        spec = client.decode(client.ask(session, f"{root}/spec", patience_s=LIMIT_S), "TaskSpec")
        listener = Listener(client, tables, session, root)
        listener.sizes = {"A": len(spec["action_low"]), "P": len(spec["proprioception_low"]), "S": spec["frame_stack"]}
        listener.sizes |= dict(zip("HWC", spec["frame_shape"].tolist(), strict=True))
        tables.check("TaskSpec", spec, dict(listener.sizes))
        listener.until(listener.enough, "enough of everything")
        reading = client.decode(client.ask(session, f"{root}/clock"), "ClockReading")
        tables.check("ClockReading", reading, {})
        assert reading["received_ns"] <= reading["answered_ns"]
        cached = client.decode(client.ask(session, f"{root}/policy/@adv/pub/**?_max=1;_anyke"), "PolicyWeights")
        refusals = {}
        for service in SERVICES:
            question = client.encode("Command", name="dance")
            reply = client.decode(client.ask(session, f"{root}/command/{service}", question), "CommandReply")
            tables.check("CommandReply", reply, {})
            assert not reply["accepted"]
            refusals[service] = reply["detail"]
        stop = client.encode("Command", name="stop")
        reply = client.decode(client.ask(session, f"{root}/command/robot_bridge", stop), "CommandReply")
        assert reply["accepted"], reply
        listener.until(
            lambda topic, fields: (
                topic == "status" and (fields["service"], fields["state"]) == (SERVICES[0], "stopped")
            ),
            "the bridge's goodbye",
        )
    heard, counts = listener.heard, {topic: len(messages) for topic, messages in listener.heard.items()}
    steps = by_number(heard["timestep"] + heard["timestep/resent"])
    actions = by_number(heard["action"], "answered_seq")
    experiences = by_number(heard["experience"] + heard["experience/resent"])
    incarnations = check_statuses(heard["status"], run, robot)
    for topic, name, service in (
        ("timestep", "incarnation", "robot_bridge"),
        ("action", "actor_incarnation", "actor"),
        ("action", "incarnation", "robot_bridge"),
        ("experience", "actor_incarnation", "actor"),
        ("credit", "learner_incarnation", "learner"),
        ("minibatch/arrays", "learner_incarnation", "learner"),
        ("finished", "incarnation", "robot_bridge"),
    ):
        assert {message[name] for message in heard[topic]} == {incarnations[service]}, topic
    check_stream(heard["timestep/head"], heard["timestep/ack"], incarnations["robot_bridge"])
    check_stream(heard["experience/head"], heard["experience/ack"], incarnations["actor"])
    assert all(credit["want_total"] >= credit["received_total"] for credit in heard["credit"])
    (finished,) = {(message["produced"], message["reason"]) for message in heard["finished"]}
    assert finished[0] >= max(steps) + 1
    stacks = rebuilt_stacks(steps, spec["frame_stack"], observation)
    experience_steps, experience_actions = check_experiences(experiences, steps, actions)
    assert reading["incarnation"] == incarnations["robot_bridge"]
    times, *offset = check_times(steps, actions)
    densities = check_log_probabilities(steps, stacks, actions, heard["policy"], spec, policy)
    assert set(policy.parameters(cached)) == set(policy.parameters(heard["policy"][-1]))
    modules = [str(getattr(module, "__file__", None)) for module in sys.modules.values()]
    result = {
        "heard": counts,
        "sent_as": listener.sent_as,
        "produced": finished[0],
        "reason": finished[1],
        "frames": sum(len(step["frame_ids"]) for step in steps.values()),
        "compared": {
            "consecutive time steps": check_time_steps(steps, spec),
            "time steps with actions": check_actions(steps, actions, spec),
            "times on two clocks": times,
            "experiences with time steps": experience_steps,
            "experiences with actions": experience_actions,
            "log-probabilities, initial policy": densities["initial"],
            "log-probabilities, pushed policy": densities["pushed"],
            "minibatch transitions": check_minibatches(heard["minibatch/arrays"], steps, stacks),
        },
        "cached_policy": cached["version"],
        "offset": offset,
        "refusals": refusals,
        "counters": {
            service: sorted({name for s in heard["status"] if s["service"] == service for name in s["counters"]})
            for service in SERVICES
        },
        "modules": sorted(modules),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main(*sys.argv[1:])
