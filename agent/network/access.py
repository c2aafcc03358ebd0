"""What Zenoh is told of who may do what: the rights of the contract as access control, which every peer enforces."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from agent.contract.keys import key
from agent.contract.problem import Problem
from agent.contract.rights import Rights, rights


def access_control(problem: Problem, *, run: str) -> dict[str, Any]:
    """Zenoh's `access_control`: who has a certificate in the name of a participant has its rights, nobody has others.

    What comes in must be that participant's to say; what goes out must be for it to hear. Who has another certificate
    is no subject here, and gets nothing.
    """
    rules, policies = list[dict[str, Any]](), list[dict[str, Any]]()
    everybody = rights(problem, run=run)
    for who, own in everybody.items():
        names = []
        for flow, messages, keys in _rules(own, everything=key(run, "**")):
            if keys:
                names.append(f"{who} {flow} {messages[0]}")
                rules.append(
                    {"id": names[-1], "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
                )
        policies.append({"id": who, "rules": names, "subjects": [who]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": who, "cert_common_names": [who]} for who in everybody],
        "policies": policies,
    }


def _rules(own: Rights, *, everything: str) -> Iterator[tuple[str, list[str], list[str]]]:
    """The flow, the messages and the key expressions of each rule of one participant."""
    yield "ingress", ["put"], own.says
    yield "ingress", ["declare_subscriber"], own.hears
    yield "ingress", ["liveliness_token"], own.shows
    yield "ingress", ["liveliness_query", "declare_liveliness_subscriber"], own.sees
    yield "ingress", ["declare_queryable"], own.answers
    yield "ingress", ["reply"], [*own.says, *own.answers] if own.answers else []
    yield "ingress", ["query"], own.asks
    yield "egress", ["put"], own.hears
    yield "egress", ["liveliness_token"], own.sees
    yield "egress", ["query"], own.answers
    yield "egress", ["reply"], [everything] if own.asks else []
    # what we ourselves want to hear, see and answer is no secret among those who have a certificate
    yield "egress", ["declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"], [everything]
    yield "egress", ["declare_queryable"], [everything]
