"""Whoever has a certificate may say, hear, show, see, answer and ask what the contract lets them, and nothing else.

Every participant of a run is a session here that shows whatever its access control lets through. An attacker with the
certificate of one of them tries everything, on every key.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import zenoh
from attackers import PATIENCE, SECONDS, configuration, let_in, wait_for_listeners

from agent.authority import Authority
from agent.contract.gains import Gains
from agent.contract.keys import RECORDER, VIEWER, participants
from agent.contract.problem import Problem
from agent.contract.rights import Rights, everybody, rights
from agent.contract.sizes import largest
from agent.network import configuration as ours
from agent.network.access import access_control
from agent.network.configuration import Network
from agent.network.credentials import Credentials
from agent.network.session import Session

RUN, OTHER = "attacked", "peakmesh/other/mode"
BLOCK, NONE = zenoh.CongestionControl.BLOCK, zenoh.ConsolidationMode.NONE
ATTACK, HONEST = "attack", "honest"  # payloads


@pytest.fixture(scope="module")
def keys(pair: Gains, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates for everybody."""
    folder = tmp_path_factory.mktemp("keys")
    Authority.create(folder, pair.problem.name, days=1).issue(everybody(pair.problem), days=1)
    return folder


MARKER = (
    "peakmesh/marker"  # the only key that tests add: where it has come, what was sent before has come, or never will
)
TO_ATTACKER = "peakmesh/marker/attacker"


def with_markers(problem: Problem, *, run: str) -> dict[str, Any]:
    """The access control of the program, which lets markers through too, and does not hide what the test listens to."""
    control = access_control(problem, run=run)
    for flow, messages, keys in (
        ("ingress", ["put"], MARKER),
        ("ingress", ["declare_subscriber"], TO_ATTACKER),
        ("egress", ["put"], TO_ATTACKER),
        ("egress", ["declare_subscriber", "declare_liveliness_subscriber"], "**"),
    ):
        name = f"test {flow} {messages[0]}"
        rule = {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": [keys]}
        control["rules"].append(rule)
        for policy in control["policies"]:
            policy["rules"].append(name)
    return control


class Reached(NamedTuple):
    """What got through."""

    said: set[tuple[str, str]]  # by the attacker: to whom, on which key
    shown: set[tuple[str, str]]  # the attacker's tokens: to whom, which
    heard: set[str]  # of the others, by the attacker: keys
    seen: set[str]  # of their tokens
    answered: set[str]  # by the attacker, to the recorder: keys
    asked: set[str]  # by the attacker, of the others, with an answer


class Peers:
    """Everybody of a run, and what reaches them."""

    def __init__(self, problem: Problem, keys: Path, stack: ExitStack) -> None:
        self.rights = rights(problem, run=RUN)
        self.names, self.arrived = participants(problem), set[tuple[str, str, str]]()
        self.seen = set[tuple[str, str]]()
        self.sessions: dict[str, zenoh.Session] = {}
        self.address = ""
        for who in self.names:
            connect = (self.address,) if self.address else ()
            network = Network("tls/127.0.0.1:0", connect, problem=problem, credentials=Credentials(keys, who))
            session = Session(network, run=RUN, who=who, hand_over=lambda duty: None)
            stack.enter_context(closing(session))
            self.sessions[who] = session._zenoh
            self.address = self.address or session.locators()[0]
            self._listen(who, session)

    def _listen(self, who: str, session: Session) -> None:
        def take(sample: zenoh.Sample) -> None:
            kind = "" if sample.kind == zenoh.SampleKind.PUT else "delete "
            if sample.payload.to_string() != HONEST:
                self.arrived.add((who, f"{kind}{sample.key_expr}", sample.payload.to_string()))

        def see(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                self.seen.add((who, str(sample.key_expr)))

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(query.key_expr, HONEST)

        opened, live = self.sessions[who], self.sessions[who].liveliness()
        session._declared += [
            *(opened.declare_queryable(question, answer) for question in self.rights[who].answers),
            live.declare_subscriber("**", see),
            opened.declare_subscriber("peakmesh/**", take),
        ]


def concrete(expressions: list[str]) -> list[str]:
    return [expression.replace("*", "x") for expression in expressions]


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@contextmanager
def peers(problem: Problem, keys: Path) -> Iterator[Peers]:
    with ExitStack() as stack:
        yield Peers(problem, keys, stack)


class Attack:
    """With the certificate of `who`."""

    def __init__(self, peers: Peers, keys: Path, who: str, stack: ExitStack) -> None:
        self._peers, everybody_has = peers, list(peers.rights.values())
        self._says = sorted({key for each in everybody_has for key in concrete(each.says)})
        self._hears = sorted({key for each in everybody_has for key in each.hears})
        self._shows = sorted({key for each in everybody_has for key in concrete(each.shows)})
        self._sees = sorted({key for each in everybody_has for key in each.sees})
        self._answers = sorted({key for each in everybody_has for key in each.answers})
        self._marked, self._markers = threading.Semaphore(0), count()
        self._session = stack.enter_context(zenoh.open(configuration(peers.address, keys, who)))
        self._session.declare_subscriber(TO_ATTACKER, lambda sample: self._marked.release())
        peers.arrived.clear()
        wait_until(self._everybody_listens)

    def all(self, tokens: set[tuple[str, str]]) -> Reached:
        said, shown = self.speak(tokens)
        heard, seen, asked = self.spy()
        return Reached(said, shown, heard, seen, self.answer(), asked)

    def speak(self, expected: set[tuple[str, str]]) -> tuple[set[tuple[str, str]], set[tuple[str, str]]]:
        """Publish, delete and show tokens on every key: what reaches whom. `expected` tokens are waited for."""
        self._peers.arrived.clear()
        self._peers.seen.clear()
        tokens = [self._session.liveliness().declare_token(token) for token in self._shows]
        for expression in (*self._says, OTHER):
            self._session.put(expression, ATTACK, congestion_control=BLOCK)
            self._session.delete(expression)
        self._there_and_back()
        wait_until(lambda: expected <= self._peers.seen)
        said = {(name, key) for name, key, _ in self._peers.arrived.copy() if key != MARKER}
        shown = self._peers.seen.copy()
        for token in tokens:
            token.undeclare()  # type: ignore[no-untyped-call]
        return said, shown

    def spy(self) -> tuple[set[str], set[str], set[str]]:
        """Listen on every key and pattern, and ask everybody everything: which messages, tokens and answers."""
        heard, seen, asked = set[str](), set[str](), set[str]()

        def hear(sample: zenoh.Sample) -> None:
            if sample.payload.to_string() == HONEST and str(sample.key_expr) != TO_ATTACKER:
                heard.add(str(sample.key_expr))

        with ExitStack() as honest:
            for name, peer in self._peers.sessions.items():
                for token in concrete(self._peers.rights[name].shows):
                    honest.enter_context(peer.liveliness().declare_token(token))
            for expression in ("**", *self._hears, *self._says):
                self._session.declare_subscriber(expression, hear)
            for expression in ("**", *self._sees):
                self._session.liveliness().declare_subscriber(
                    expression, lambda sample: seen.add(str(sample.key_expr)), history=True
                )
            for question in self._answers:
                self._session.get(question, lambda reply: asked.add(str(reply.ok.key_expr)))
            self._there_and_back()
        return heard, seen, asked

    def answer(self) -> set[str]:
        """Answer the recorder in everybody's name, with messages of everybody: what it takes."""

        def lie(query: zenoh.Query) -> None:
            with query:
                for expression in (*self._says, *self._answers):
                    query.reply(expression, ATTACK)

        for question in self._answers:
            self._session.declare_queryable(question, lie)
        self._there_and_back()
        taken = set[str]()
        for question in self._answers:
            for reply in self._peers.sessions[RECORDER].get(
                f"{question}?_anyke", target=zenoh.QueryTarget.ALL, consolidation=NONE, timeout=PATIENCE
            ):
                if reply.ok is not None and reply.ok.payload.to_string() == ATTACK:
                    taken.add(str(reply.ok.key_expr))
        return taken

    def _there_and_back(self) -> None:
        """Until everything sent so far has come to everybody, and what everybody says has come back."""
        marker = self._mark()
        wait_until(lambda: self._has_come(marker))
        for name, peer in self._peers.sessions.items():
            for expression in concrete(self._peers.rights[name].says):
                peer.put(expression, HONEST, congestion_control=BLOCK)
            peer.put(TO_ATTACKER, HONEST, congestion_control=BLOCK)
        for _ in self._peers.names:
            assert self._marked.acquire(timeout=PATIENCE)

    def _mark(self) -> str:
        marker = f"{ATTACK} {next(self._markers)}"
        self._session.put(MARKER, marker, congestion_control=BLOCK)
        return marker

    def _everybody_listens(self) -> bool:
        """And has told us: some marker has come to each."""
        self._mark()
        return {name for name, key, _ in self._peers.arrived.copy() if key == MARKER} == set(self._peers.names)

    def _has_come(self, marker: str) -> bool:
        return {(name, MARKER, marker) for name in self._peers.names} <= self._peers.arrived


def attack(peers: Peers, keys: Path, who: str, *, tokens: set[tuple[str, str]]) -> Reached:
    with ExitStack() as stack:
        return Attack(peers, keys, who, stack).all(tokens)


def allowed(peers: Peers, who: str) -> Reached:
    """What the contract lets through."""
    own: Rights = peers.rights[who]
    honest = {key for name in peers.names for key in concrete(peers.rights[name].says)}
    tokens = {token for name in peers.names for token in concrete(peers.rights[name].shows)}
    return Reached(
        said={(name, key) for name in peers.names for key in concrete(own.says)},
        shown={(name, token) for name in peers.names for token in concrete(own.shows)},
        heard={key for key in honest if any(zenoh.KeyExpr(each).includes(zenoh.KeyExpr(key)) for each in own.hears)},
        seen={key for key in tokens if any(zenoh.KeyExpr(each).includes(zenoh.KeyExpr(key)) for each in own.sees)},
        answered={*concrete(own.says), *own.answers} if own.answers else set(),
        asked=set(own.asks),
    )


def test_a_certificate_is_worth_what_the_contract_says(
    pair: Gains, keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With each certificate everything is tried; what its owner may do gets through to everybody, and nothing else."""
    monkeypatch.setattr(ours, "access_control", with_markers)
    with peers(pair.problem, keys) as there:
        for who in everybody(pair.problem):
            may = allowed(there, who)
            reached = attack(there, keys, who, tokens=may.shown)
            for kind, got, wanted in zip(Reached._fields, reached, may, strict=True):
                assert (got - wanted, wanted - got) == (set(), set()), f"{who}: {kind}: too much, too little"


def test_without_access_control_everything_gets_through(
    pair: Gains, keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that the test above means something: one certificate is enough for every lie, and to hear everything."""
    monkeypatch.setattr(ours, "access_control", lambda problem, *, run: {"enabled": False})
    with peers(pair.problem, keys) as there:
        names = there.names
        everything = {key for each in there.rights.values() for key in concrete(each.says)}
        tokens = {token for each in there.rights.values() for token in concrete(each.shows)}
        honest = [there.rights[name] for name in names]
        shown = {(name, token) for name in names for token in tokens}
        reached = attack(there, keys, VIEWER, tokens=shown)
    kinds = [*everything, OTHER, *(f"delete {key}" for key in (*everything, OTHER))]
    assert reached == Reached(
        said={(name, key) for name in names for key in kinds},
        shown=shown,
        heard={key for each in honest for key in concrete(each.says)},
        seen={token for each in honest for token in concrete(each.shows)},
        answered=everything | {key for each in there.rights.values() for key in each.answers},
        asked={key for each in honest for key in each.answers},
    )


def test_who_has_no_valid_certificate_gets_nothing(pair: Gains, keys: Path, tmp_path: Path) -> None:
    """None, one of another authority, an expired one; nor without TLS. Nor does the one to whom others connect."""
    problem = pair.problem
    other, mixed, expired = tmp_path / "other", tmp_path / "mixed", tmp_path / "expired"
    other.mkdir()
    Authority.create(other, problem.name, days=1).issue(["node-n0"], days=1)
    for folder in (mixed, expired):
        shutil.copytree(keys, folder)
    for kind in ("pem", "key"):
        shutil.copy(other / f"node-n0.{kind}", mixed)
    Authority.load(expired).issue(["node-n0"], days=-0.5)  # type: ignore[arg-type]
    with peers(problem, keys) as there:
        address, plain = there.address, there.address.replace("tls/", "tcp/")
        assert let_in(
            {
                "with a certificate": configuration(address, keys, "node-n0"),
                "no certificate": configuration(address, keys, seconds=SECONDS),
                "another authority": configuration(address, other, "node-n0", seconds=SECONDS),
                "another authority's certificate": configuration(address, mixed, "node-n0", seconds=SECONDS),
                "expired": configuration(address, expired, "node-n0", seconds=SECONDS),
                "no TLS": configuration(plain, None, seconds=SECONDS),
            }
        ) == {"with a certificate"}
        why = {folder.name: Credentials(folder, "node-n0").why_not(address) for folder in (other, mixed, expired)}
    assert why["other"].startswith(f"who listens at {address} has no certificate that {other}/ca.pem vouches for: ")
    assert why["mixed"].startswith(f"who listens at {address} does not accept {mixed}/node-n0.pem: ")
    assert why["expired"] == f"who listens at {address} does not accept {expired}/node-n0.pem: certificate expired"


def test_what_is_larger_than_any_message_does_not_come_in(pair: Gains) -> None:
    """With and without keys: in one piece or in many, published or as an answer; what is as large as can be does."""
    limit = largest(pair.problem)
    arrived = list[int]()
    done = threading.Event()

    def take(sample: zenoh.Sample) -> None:
        size = len(sample.payload.to_bytes())
        if size:
            arrived.append(size)
        else:
            done.set()

    network = Network("tcp/127.0.0.1:0", largest=limit)
    with closing(Session(network, run=RUN, who=RECORDER, hand_over=lambda duty: None)) as session:
        session._declared.append(session._zenoh.declare_subscriber("peakmesh/**", take))
        with zenoh.open(configuration(session.locators()[0], None)) as attacker:
            wait_for_listeners(attacker, ["peakmesh/any"])
            attacker.declare_queryable("question", lambda query: query.reply("question", bytes(limit + 1)))
            for size in (limit, limit + 1, 2 * limit, 50 * limit, limit - 1, 0):
                attacker.put("peakmesh/any", bytes(size), congestion_control=BLOCK)
            assert done.wait(PATIENCE)
            replies = [reply.ok for reply in session._zenoh.get("question", timeout=PATIENCE)]
    assert arrived == [limit, limit - 1]
    assert replies == []
