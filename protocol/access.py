"""The hub's access rules: who may publish which keys, by the common name in each client's certificate."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from buddyline.protocol.security import PLAYER, ROS, SOLVER, SURVEYOR, VIEWER, node_name
from buddyline.protocol.topics import EXPECT, LOG, TOPICS, Topic

_ASK: Final = ["declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query"]
# The keys that `ros2` publishes: domain, topic, type, and the type's hash. They have more chunks than any Buddyline
# key behind a namespace, so they match none of them.
_ROS_KEYS: Final = [
    *("*/buddyline/*/attitude/*/*", "*/buddyline/*/depth/*/*", "*/buddyline/*/*/pose/*/*", "*/tf/*/*"),
    *("*/buddyline/*/*/track/*/*", "*/buddyline/*/*/track_lag/*/*", "*/buddyline/*/*/range/*/*"),
    *("*/buddyline/*/camera/image/compressed/*/*", "*/buddyline/*/camera/camera_info/*/*", "*/diagnostics/*/*"),
    "@ros2_lv/**",
]
# What nodes publish: all topics of a node but those that the solver computes for it.
_OF_NODES: Final = tuple(topic for topic in TOPICS if topic.id_fields == ("node",) and not topic.solved)
_SAY: Final = ["put", "delete", "reply", "declare_queryable", "liveliness_token"]


def access_rules(nodes: Iterable[str], namespace: str = "", shut_out: Iterable[str] = ()) -> dict[str, object]:
    """Return Zenoh's `access_control`: a node publishes its own keys, the solver its results; all clients read all.

    A surveyor publishes marks for any node. A player publishes the keys of all nodes of a stored dive. A bridge to ROS
    publishes ROS's keys. Everything else is denied. Heartbeats, and what publishers hold, are under `@adv`, which `*`
    and `**` do not match; each rule therefore also names them, because history would otherwise be lost silently.
    shut_out: names of certificates that may neither publish nor read.
    """
    root = f"{namespace}/buddyline" if namespace else "buddyline"
    everything = [f"{root}/**", f"{root}/**/@adv/**", f"{root}/@alive/**", *_ROS_KEYS]
    gone = set(shut_out)
    nodes = [node for node in nodes if node_name(node) not in gone]
    clients = [node_name(node) for node in nodes]
    clients += [role for role in (SOLVER, VIEWER, SURVEYOR, PLAYER, ROS) if role not in gone]
    rules: list[dict[str, object]] = [
        _rule("ask", ["ingress", "egress"], _ASK, everything),
        _rule("hear", ["egress"], _SAY, everything),
    ]
    policies: list[dict[str, object]] = [{"rules": ["ask", "hear"], "subjects": clients}]
    for name, keys, alive in [
        *((node_name(node), _said_by(node), f"node/{node}") for node in nodes),
        (SOLVER, ["pair/*/*/*", "net/*/*", _short(EXPECT, "*")], "solver"),
        (VIEWER, [], "viewer"),
        (SURVEYOR, ["node/*/mark"], "surveyor"),
        (
            PLAYER,
            [*(_short(topic, "*") for topic in _OF_NODES), "pair/*/*/truth", "pair/*/*/artag", "net/*/truth/*"],
            "player",
        ),
    ]:
        if name in gone:
            continue
        own = [f"{root}/@alive/{alive}/**"] + [f"{root}/{key}{end}" for key in keys for end in ("", "/@adv/**")]
        rules.append(_rule(f"say {name}", ["ingress"], _SAY, own))
        policies.append({"rules": [f"say {name}"], "subjects": [name]})
    if ROS not in gone:
        rules.append(_rule(f"say {ROS}", ["ingress"], _SAY, _ROS_KEYS))
        policies.append({"rules": [f"say {ROS}"], "subjects": [ROS]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in clients],
        "policies": policies,
    }


def _said_by(node: str) -> list[str]:
    """Return the keys of a node below the root: its topics, and the one on which it answers from its log."""
    return [*(_short(topic, node) for topic in _OF_NODES), LOG.removeprefix("buddyline/").format(node=node)]


def _short(topic: Topic, node: str) -> str:
    """Return a node topic's key below the root. node: an id, or "*" for all nodes."""
    return topic.template.removeprefix("buddyline/").format(node=node)


def _rule(name: str, flows: list[str], messages: list[str], keys: list[str]) -> dict[str, object]:
    return {"id": name, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": keys}
