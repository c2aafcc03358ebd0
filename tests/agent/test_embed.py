"""A node as C computes what the agent computes, to the last bit; and its self-test finds every node that does not."""

from __future__ import annotations

import json
import math
import os
import platform
import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from here import here
from made_recordings import Sent, observer_gains, random_gains, random_problem, real_problem, record
from places import GOLDEN, ROOT
from runs import logged
from simulated.network import Weather
from simulated.night import simulated
from simulated.scenario import Scenario

from agent.contract.errors import InputError
from agent.contract.gains import Gains
from agent.contract.problem import Problem
from agent.embed import export
from agent.embed.compiler import build
from agent.embed.names import identifiers
from agent.plan import Pace, Plan

STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror", "-ffp-contract=off"]
FUSED = ["-std=c99", "-O2", "-ffp-contract=fast", *(["-mfma"] if platform.machine() == "x86_64" else [])]
STEPS = 25
LOSSY = GOLDEN / "zhu2020-lossy.gains.json"


def tool(*names: str) -> str:
    """A program of this machine, or the test is skipped."""
    found = next((found for name in names if (found := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"{' or '.join(names)} is not installed")
    return found


def said(*command: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*map(str, command)], cwd=cwd, capture_output=True, text=True, timeout=300, check=False)


def checked(folder: Path, flags: Sequence[str] = STRICT) -> subprocess.CompletedProcess[str]:
    """The self-test of the node in a folder, compiled with these flags."""
    compiler = tool("gcc", "cc", "clang")
    made = said(compiler, *flags, "-o", "test", *sorted(folder.glob("*.c")), cwd=folder)
    assert (made.returncode, made.stderr) == (0, "")
    return said(folder / "test")


def numbers(own: Gains, node: str, steps: int) -> int:
    """In so many steps."""
    problem = own.problem
    return steps * (problem.nx + len(problem.nodes[problem.node_index(node)].C) + problem.nz)


def renamed(gains: Gains, names: dict[str, str]) -> Gains:
    """The same network with other names."""
    text = gains.canonical().decode()
    for old, new in names.items():
        text = text.replace(f'"{old}"', f'"{new}"')
    document = json.loads(text)
    document["problem_digest"] = Problem.from_document(document["problem"]).digest()
    return Gains.from_document(document)


SIZES: dict[str, Any] = {"ny": (1, 2, 1), "modes": 3, "nx": 3, "nz": 2}
NETWORKS: dict[str, Callable[[], Gains]] = {
    "hidden losses": lambda: random_gains(random_problem(5, ny=(1, 2, 1), modes=2)),
    "seen losses": lambda: random_gains(real_problem(2, links=False, unbiased=False, **SIZES)),
    "lossy links": lambda: random_gains(real_problem(3, seen=False, unbiased=False, **SIZES)),
    "unbiased": lambda: observer_gains(real_problem(4, seen=False, links=False, **SIZES)),
    "all, and names that C does not take": lambda: renamed(
        observer_gains(real_problem(2, radius=1.02, **SIZES)),
        {"n1": "a-b", "n2": "A_B", "mode-1": "int", "mode-2": "INT"},
    ),
}


TOLD = r"""
#include <stdio.h>
#define ALL(what, n, ...) do { int i; printf(", \"" what "\": ["); for (i = 0; i < n; i++) { \
    printf(i ? ", " : ""); printf(__VA_ARGS__); } printf("]"); } while (0)
int main(void)
{
    int s, j;
    printf("{\"name\": \"%s\", \"gains\": \"%s\", \"draws\": %d", THIS_NAME, THIS_GAINS, THIS_DRAWS);
    ALL("nodes", THIS_NODES, "\"%s\"", this_nodes[i]);
    ALL("senders", THIS_SENDERS, "[\"%s\", %d]", this_senders[i], this_ny[i]);
    ALL("modes", THIS_MODES, "\"%s\"", this_modes[i]);
    ALL("lossy", THIS_LOSSY, "[%d, %d, %.17g]", this_links[i].draw, this_links[i].sender, this_links[i].arrives);
    printf(", \"hears\": [");
    for (s = 0; s < THIS_MODES; s++) {
        printf(s ? ", [" : "[");
        for (j = 0; j < THIS_SENDERS; j++)
            printf("%s%d", j ? ", " : "", this_hears[s][j]);
        printf("]");
    }
    printf("]}");
    return 0;
}
"""


# the same bits
@pytest.mark.parametrize("node", "1234")
def test_a_golden_recording_comes_back(node: str, tmp_path: Path) -> None:
    gains = Gains.load(LOSSY)
    facts = export(gains, node, tmp_path, recording=GOLDEN / "zhu2020-lossy.mcap")
    done = checked(tmp_path)
    assert (done.stdout, done.returncode) == (f'node "{node}": 60 steps, 240 numbers, 0 differ\n', 0)
    assert (facts["steps"], facts["begins"]) == (60, 0)


@pytest.mark.parametrize("kind", NETWORKS)
def test_a_run_comes_back(kind: str, tmp_path: Path) -> None:
    """Of the production roles, in lock-step, every node of it."""
    gains = NETWORKS[kind]()
    with simulated(Scenario(1, gains, Plan(STEPS, 1), Weather())) as outcome:
        for node in gains.problem.node_names:
            facts = export(gains, node, tmp_path / node, recording=outcome.recording)
            done = checked(tmp_path / node)
            assert done.stdout == f'node "{node}": {STEPS} steps, {numbers(gains, node, STEPS)} numbers, 0 differ\n'
            assert (done.returncode, facts["begins"]) == (0, 0)


def test_a_paced_run_comes_back_though_the_node_began_again(tmp_path: Path) -> None:
    gains, steps = NETWORKS["lossy links"](), 60
    faults = ("kill:node=n1,step=20", "drop:probability=0.2")
    with simulated(Scenario(1, gains, Plan(steps, 1, pace=Pace(0.05), faults=faults), Weather())) as outcome:
        facts = export(gains, "n1", tmp_path, recording=outcome.recording)
    done = checked(tmp_path)
    assert (done.returncode, facts["begins"]) == (0, 1), done.stdout
    assert steps // 2 < facts["steps"] < steps  # the killed node lacks a few


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("kind", ["seen losses", "all, and names that C does not take"])
def test_the_agents_own_filter_comes_back(kind: str, single: bool, tmp_path: Path) -> None:
    """Measurements and pairs that do not arrive, beginnings, numbers over twelve decades."""
    gains = NETWORKS[kind]()
    node = gains.problem.node_names[1]
    export(gains, node, tmp_path, single=single)
    done = checked(tmp_path)
    assert (done.stdout, done.returncode) == (
        f'node "{node}": 200 steps, {numbers(gains, node, 200)} numbers, 0 differ\n',
        0,
    )


def test_float_says_how_far_it_is_from_the_recording(tmp_path: Path) -> None:
    gains, recording = Gains.load(LOSSY), GOLDEN / "zhu2020-lossy.mcap"
    facts = export(gains, "2", tmp_path, single=True, recording=recording)
    told = [json.loads(message.payload) for message in logged(recording) if message.topic == "node/2/estimate"]
    largest = max(abs(x) for message in told for x in message["x_hat"])
    assert facts["largest"] == pytest.approx(largest, rel=1e-5)
    assert 1e-10 * largest < facts["off"] < 1e-5 * largest
    assert checked(tmp_path).returncode == 0


def rewritten(path: Path, change: Callable[[str, dict[str, Any]], bool]) -> Path:
    """The golden recording without those messages of which `change`, which may change them, says False."""
    sent = []
    for message in logged(GOLDEN / "zhu2020-lossy.mcap"):
        document = json.loads(message.payload)
        if change(message.topic, document):
            sent.append(Sent(message.topic, message.topic, message.number, document))
    return record(path, Gains.load(LOSSY), sent, steps=60, whole=False, evidence=False)


def test_where_a_recording_has_a_gap_the_self_test_begins_again(tmp_path: Path) -> None:
    """At step 31, and at 41: a node that has lost its estimate, or its measurement, says nothing of that step."""
    lost = {("node/2/estimate", 30), ("node/2/measurement", 40)}
    path = rewritten(tmp_path / "run.mcap", lambda topic, document: (topic, document["step"]) not in lost)
    facts = export(Gains.load(LOSSY), "2", tmp_path / "node", recording=path)
    assert (facts["steps"], facts["begins"]) == (58, 2)
    assert checked(tmp_path / "node").stdout == 'node "2": 58 steps, 232 numbers, 0 differ\n'


def test_what_a_node_did_not_hear_is_not_made_up(tmp_path: Path) -> None:
    """Where the recording has lost a message that it heard, the self-test begins again after it."""
    lost = {(f"node/{node}/estimate", 30) for node in "134"}
    path = rewritten(tmp_path / "run.mcap", lambda topic, document: (topic, document["step"]) not in lost)
    facts = export(Gains.load(LOSSY), "2", tmp_path / "node", recording=path)
    assert (facts["steps"], facts["begins"]) == (60, 1)
    assert checked(tmp_path / "node").returncode == 0


def test_a_changed_number_is_caught(tmp_path: Path) -> None:
    """Teeth: the vectors are those of the recording, not of the agent's filter."""

    def change(topic: str, document: dict[str, Any]) -> bool:
        if (topic, document["step"]) == ("node/2/estimate", 17):
            document["z_hat"][0] = math.nextafter(document["z_hat"][0], 1.0)
        return True

    export(Gains.load(LOSSY), "2", tmp_path / "node", recording=rewritten(tmp_path / "run.mcap", change))
    done = checked(tmp_path / "node")
    assert (done.returncode, done.stdout[:25]) == (1, 'node "2": step 17: z_hat[')


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [("mode", "9", 'there is no mode "9"'), ("x_hat", [1.0], "another number of numbers than its gains ask for")],
)
def test_a_recording_that_cannot_be_of_these_gains_is_refused(
    field: str, value: object, sentence: str, tmp_path: Path
) -> None:
    def change(topic: str, document: dict[str, Any]) -> bool:
        if (topic, document["step"]) == ("node/2/estimate", 17):
            document[field] = value
        return True

    path = rewritten(tmp_path / "run.mcap", change)
    with pytest.raises(InputError, match=sentence):
        export(Gains.load(LOSSY), "2", tmp_path / "node", recording=path)
    assert not (tmp_path / "node").exists()


# teeth
@pytest.fixture
def unbiased(tmp_path: Path) -> Path:
    """A node of every kind of loss, and its self-test."""
    export(observer_gains(real_problem(2, radius=1.02, **SIZES)), "n1", tmp_path)
    return tmp_path


def test_a_fused_build_is_caught(unbiased: Path) -> None:
    if platform.machine() == "x86_64" and "fma" not in Path("/proc/cpuinfo").read_text().split():
        pytest.skip("this processor fuses nothing")
    if platform.machine() not in ("x86_64", "aarch64"):
        pytest.skip(f"how {platform.machine()} is told to fuse is not known here")
    done = checked(unbiased, FUSED)
    assert done.returncode == 1
    assert re.match(r'node "n1": step \d+: \w+\[\d\] is -?0x1\.\w+p\S+, must be -?0x1\.\w+p\S+ \(', done.stdout)


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["-ffast-math"], "-ffast-math reorders sums"),
        (["-mfpmath=387"], "computes in wider numbers than double"),
        (["-include", "short.h"], "double is not an IEEE 754 number of 64 bits here"),
    ],
)
def test_what_would_compute_otherwise_does_not_compile(flags: list[str], says: str, unbiased: Path) -> None:
    compiler = tool("gcc")
    if "-mfpmath=387" in flags and platform.machine() != "x86_64":
        pytest.skip("x87 is of x86-64")
    (unbiased / "short.h").write_text("#include <float.h>\n#undef DBL_MANT_DIG\n#define DBL_MANT_DIG 24\n")
    done = said(compiler, *STRICT, *flags, "-fsyntax-only", "node_n1.c", cwd=unbiased)
    assert (done.returncode, says in done.stderr) == (1, True)


MUTANTS = {
    "uses what was not heard": ("pair->heard ? pair->x_hat : own", "pair->x_hat"),
    "uses an innovation that was not heard": ("(pair->heard ? pair->innovation[c] : 0x0.0p+0)", "pair->innovation[c]"),
    "takes x_hat_j, not x_hat_j - x_hat_i": ("(x_hat[c] - own[c])", "x_hat[c]"),
    "keeps an old innovation": (": 0x0.0p+0;\n    own->heard", ": own->innovation[r];\n    own->heard"),
    "does not count itself as heard": ("own->heard = 1", "own->heard = 0"),
    "does not forget what it heard": ("node->from[j].heard = 0;\n    return", "(void)j;\n    return"),
    "forgets the state where it begins again": ("x_hat ? x_hat[c] : 0x0.0p+0", "0x0.0p+0 * (x_hat ? x_hat[c] : 1.0)"),
    "keeps the state where it begins with 0": (
        "x_hat ? x_hat[c] : 0x0.0p+0",
        "x_hat ? x_hat[c] : node->from[SELF].x_hat[c]",
    ),
    "sums y before": ("y ? y[r] - times(", "y ? 1.0 + (y[r] - 1.0) - times("),
    "has rows in another order": ("modes[mode].rows + r *", "modes[mode].rows + (NX - 1 - r) *"),
    "updates x_hat while it is used": ("        next[r] = ", "        node->from[SELF].x_hat[r] = next[r] = "),
    "refuses its largest mode": ("mode >= NODE_N1_MODES", "mode >= NODE_N1_MODES - 1"),
}  # fmt: skip


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_wrong_node_is_caught(mutant: str, unbiased: Path) -> None:
    source, (right, wrong) = unbiased / "node_n1.c", MUTANTS[mutant]
    text = source.read_text()
    assert text.count(right) == 1
    source.write_text(text.replace(right, wrong))
    assert checked(unbiased, ["-std=c99", "-ffp-contract=off"]).returncode == 1


def test_a_last_digit_is_caught(unbiased: Path) -> None:
    """Of one gain."""
    source = unbiased / "node_n1.c"
    head, mark, tail = source.read_text().partition("static const real rows[] = {")
    digit = re.search(r"0x1\.\w{12}(\w)p", tail)
    assert digit is not None
    at, other = digit.start(1), "0" if digit[1] != "0" else "1"
    source.write_text(head + mark + tail[:at] + other + tail[at + 1 :])
    assert checked(unbiased).returncode == 1


# what it needs
def test_a_node_needs_nobody(unbiased: Path) -> None:
    """No symbol from outside, no memory of its own; and its functions alone are seen."""
    compiler, nm = tool("gcc"), tool("nm")
    for optimised in ("-Os", "-O2", "-O3"):
        assert said(compiler, *STRICT, optimised, "-c", "node_n1.c", cwd=unbiased).returncode == 0
        symbols = said(nm, "-g", "node_n1.o", cwd=unbiased).stdout.split("\n")
        seen = {line.split()[-1]: line.split()[-2] for line in symbols if line}
        assert seen == {f"node_n1_{name}": "T" for name in ("init", "innovation", "z_hat", "step", "rejoin")}
    built = build(unbiased, "node_n1")
    assert built is not None
    assert built.passes
    if built.text is not None:
        assert (built.text > 0, built.data, built.bss) == (True, 0, 0)
    assert built.stack is None or 0 < built.stack < 1000


def test_the_gains_are_named(unbiased: Path) -> None:
    gains = observer_gains(real_problem(2, radius=1.02, **SIZES))
    assert f'#define NODE_N1_GAINS "{gains.digest()}"\n' in (unbiased / "node_n1.h").read_text()


def random_bits() -> int:
    """Of addresses, as the kernel chooses them; very many where it does not say."""
    try:
        return int(Path("/proc/sys/vm/mmap_rnd_bits").read_text())
    except OSError:
        return 99


def test_sanitizers_have_nothing_to_say(unbiased: Path) -> None:
    kinds = "address,undefined" if random_bits() <= 28 else "undefined"  # with more that of gcc 12 breaks now and then
    compiler, flags = tool("gcc", "clang"), [f"-fsanitize={kinds}", "-fno-sanitize-recover=all"]
    (unbiased / "empty.cc").write_text("int main(void) { return 0; }\n")
    if said(compiler, *flags, "-x", "c", "empty.cc", cwd=unbiased).returncode:
        pytest.skip(f"{compiler} has no sanitizers here")
    assert checked(unbiased, [*STRICT, *flags]).stderr == ""


def test_cppcheck_has_nothing_to_say(unbiased: Path) -> None:
    checked = said(tool("cppcheck"), "--std=c99", "--enable=warning,performance,portability", "--quiet",
                   "--error-exitcode=1", *unbiased.glob("*.c"))  # fmt: skip
    assert (checked.returncode, checked.stderr) == (0, "")


BOARD = """
extern void _start(void);
static void reset(void)
{
    *(volatile unsigned *)0xE000ED88u |= 0xFu << 20; /* the FPU on, where there is one */
    _start();
}
__attribute__((section(".vectors"), used)) static void (*const vectors[])(void) = {(void (*)(void))0x20010000u, reset};
"""
BARE = "-mthumb --specs=rdimon.specs -Wl,--section-start=.vectors=0"  # prints by semihosting
CORTEX = {  # flags, and the machine of qemu; it has no M0+ with so much memory, and an M3 runs the same code
    "Cortex-M0+": ("-mcpu=cortex-m0plus", "mps2-an385"),
    "Cortex-M4": ("-mcpu=cortex-m4 -mfloat-abi=hard -mfpu=fpv4-sp-d16", "mps2-an386"),
    "Cortex-M7": ("-mcpu=cortex-m7 -mfloat-abi=hard -mfpu=fpv5-d16", "mps2-an500"),
}


@pytest.fixture(params=[False, True], ids=["double", "float"])
def recorded(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A node with the golden recording."""
    gains, recording = Gains.load(LOSSY), GOLDEN / "zhu2020-lossy.mcap"
    export(gains, "2", tmp_path, single=request.param, recording=recording)
    return tmp_path


@pytest.mark.parametrize("core", CORTEX)
def test_a_microcontroller_has_the_same_bits(core: str, recorded: Path) -> None:
    """Emulated; a fused build is caught there, too, where the processor can."""
    compiler, emulator = tool("arm-none-eabi-gcc"), tool("qemu-system-arm")
    flags, machine = CORTEX[core]
    files = sorted(recorded.glob("*.c"))
    (recorded / "board.c").write_text(BOARD)

    def run(*more: str) -> subprocess.CompletedProcess[str]:
        made = said(
            compiler, *more, "-O2", *flags.split(), *BARE.split(), "-o", "test.elf", *files, "board.c", cwd=recorded
        )
        assert (made.returncode, made.stderr) == (0, "")
        plain = ["-semihosting", "-nographic", "-monitor", "none", "-serial", "none"]
        return said(emulator, "-M", machine, *plain, "-kernel", "test.elf", cwd=recorded)

    done = run(*STRICT)
    assert (done.stdout, done.returncode) == ('node "2": 60 steps, 240 numbers, 0 differ\n', 0)
    if core == "Cortex-M7":
        assert run("-std=c99", "-ffp-contract=fast").returncode == 1


def test_aarch64_has_the_same_bits(recorded: Path) -> None:
    """Emulated; and a fused build is caught."""
    compiler, emulator = tool("aarch64-linux-gnu-gcc"), tool("qemu-aarch64", "qemu-aarch64-static")

    def run(*flags: str) -> subprocess.CompletedProcess[str]:
        made = said(compiler, *flags, "-O2", "-static", "-o", "test", *recorded.glob("*.c"), cwd=recorded)
        assert (made.returncode, made.stderr) == (0, "")
        return said(emulator, recorded / "test")

    done = run(*STRICT)
    assert (done.stdout, done.returncode) == ('node "2": 60 steps, 240 numbers, 0 differ\n', 0)
    assert run("-std=c99", "-ffp-contract=fast").returncode == 1


# names
def test_no_two_names_are_taken_for_each_other() -> None:
    """Nor does one begin like another: constants of node "2" would be those of a node "2_mode"."""
    names = ["2", "2-mode", "2_MODE", "a-b", "a_b", "A-B", "int", "x", "_", "-", "1_2", "x2"]
    made = identifiers("node", names)
    assert all(re.fullmatch(r"NODE\d*_\w+", one, re.ASCII) for one in made)
    for one in made:
        assert [other for other in made if f"{other}_".startswith(f"{one}_")] == [one]
    assert made[6] == "NODE_INT"


def test_two_nodes_fit_into_one_program(tmp_path: Path) -> None:
    compiler = tool("gcc", "cc", "clang")
    gains = NETWORKS["all, and names that C does not take"]()
    names = [export(gains, node, tmp_path)["name"] for node in ("a-b", "A_B")]
    lines = [f'#include "{name}.h"' for name in names]
    calls = " ".join(f"static {name}_state s{i}; {name}_init(&s{i});" for i, name in enumerate(names))
    (tmp_path / "both.c").write_text("\n".join([*lines, f"int main(void) {{ {calls} return 0; }}\n"]))
    files = ["both.c", *(f"{name}.c" for name in names)]
    made = said(compiler, *STRICT, "-o", "both", *files, cwd=tmp_path)
    assert (made.returncode, made.stderr) == (0, "")


@pytest.mark.parametrize("kind", ["lossy links", "all, and names that C does not take"])
def test_what_a_node_in_a_run_has_to_know_is_that_of_the_network(kind: str, tmp_path: Path) -> None:
    """Names, whom it hears in which mode, how many numbers it is told, and which draws lose what."""
    compiler, gains = tool("gcc", "cc", "clang"), NETWORKS[kind]()
    problem, node = gains.problem, gains.problem.node_names[1]
    name = export(gains, node, tmp_path)["name"]
    (tmp_path / "told.c").write_text(f'#include "{name}_run.h"\n{TOLD}')
    made = said(compiler, *STRICT, "-o", "told", "told.c", cwd=tmp_path)
    assert (made.returncode, made.stderr) == (0, "")
    heard = sorted({1, *problem.ever_heard(1)})
    lossy = [
        [draw, heard.index(problem.node_index(link.sender)), link.delivery_probability]
        for draw, link in enumerate(problem.links)
        if link.receiver == node
    ]
    assert lossy
    assert json.loads(said(tmp_path / "told").stdout) == {
        "name": node,
        "gains": gains.digest(),
        "nodes": list(problem.node_names),
        "draws": len(problem.links),
        "senders": [[problem.node_names[j], len(problem.nodes[j].C)] for j in heard],
        "modes": list(problem.mode_names),
        "hears": [[int(j in problem.neighbours(s, 1)) for j in heard] for s in range(len(problem.topologies))],
        "lossy": lossy,
    }


def test_what_the_document_names_is_in_the_header(tmp_path: Path) -> None:
    """Functions, types and constants of node 2."""
    export(Gains.load(LOSSY), "2", tmp_path)
    there = set(re.findall(r"\w+", (tmp_path / "node_2.h").read_text()))
    named = set(re.findall(r"\b(?:node_2_|NODE_2_)\w+", (ROOT / "docs" / "embedded.md").read_text()))
    assert {"node_2_step", "NODE_2_GAINS"} < named
    assert named - there - {"node_2_selftest", "node_2_run"} == set()


# the command
def exported(*words: object) -> subprocess.CompletedProcess[str]:
    return here("export", LOSSY, "--c", *words)


def test_the_command_tells_what_it_did(tmp_path: Path) -> None:
    tool("gcc", "cc", "clang")
    done = exported(
        "--node", "2", "-o", tmp_path / "new" / "node2", "--vectors", GOLDEN / "zhu2020-lossy.mcap", "--steps", 30
    )
    assert done.returncode == 0
    assert 'node "2": 30 steps, 120 numbers, 0 differ' in done.stdout
    assert sorted(path.name for path in (tmp_path / "new/node2").iterdir()) == [
        "node_2.c",
        "node_2.h",
        "node_2_run.h",
        "node_2_selftest.c",
    ]


def test_without_a_compiler_it_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    done = exported("--node", "2", "-o", tmp_path / "node2")
    assert (done.returncode, "there is no C compiler here" in done.stdout) == (0, True)


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["-include", "other.h"], "step 1: node_2_step answers -2, must answer 0"),
        (["-ffast-math"], "-ffast-math reorders sums"),
    ],
)
def test_a_compiler_that_makes_another_node_of_it_ends_in_exit_code_1(
    flags: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler, wrapper = tool("gcc", "cc", "clang"), tmp_path / "cc"
    (tmp_path / "other.h").write_text("#include <float.h>\n#undef DBL_MAX\n#define DBL_MAX 0.1\n")
    wrapper.write_text(f'#!/bin/sh\nexec {compiler} -I{tmp_path} "$@" {" ".join(flags)}\n')
    wrapper.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    done = exported("--node", "2", "-o", tmp_path / "node2", "--vectors", GOLDEN / "zhu2020-lossy.mcap")
    assert (done.returncode, "self-test  FAILS" in done.stdout, says in done.stdout) == (1, True, True), done.stdout


def large(path: Path) -> Path:
    """Gains beyond float."""
    gains = NETWORKS["hidden losses"]()
    H = {mode: {i: {j: 1e60 * h for j, h in of.items()} for i, of in each.items()} for mode, each in gains.H.items()}
    gains.model_copy(update={"H": H}).save(path)
    return path


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([LOSSY, "--c"], '--c is of one node; name it with --node: "1", "2", "3"'),
        ([LOSSY, "--c", "--node", "7"], 'node "7" does not exist; the problem has nodes "1"'),
        ([LOSSY, LOSSY, "--c", "--node", "1"], "--c takes one gains file, not 2"),
        ([LOSSY, "--c", "--node", "1", "--wide"], "--wide says something of a recording"),
        ([GOLDEN / "zhu2020-lossy.mcap", "--c", "--node", "1"], "is not a gains file: it is a recording"),
        ([GOLDEN / "zhu2020-lossy.mcap", "--csv", "--node", "1"], "--node is for --c"),
        ([LOSSY, "--c", "--node", "1", "--vectors", GOLDEN / "zhu2020-ideal.mcap"], "needs a recording of the same"),
        ([LOSSY, "--c", "--node", "1", "--vectors", LOSSY], "gains.json is not a recording"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(words: list[object], sentence: str, tmp_path: Path) -> None:
    done = here("export", *words, "-o", tmp_path / "node")
    assert (done.returncode, done.stdout) == (2, "")
    assert sentence in done.stderr
    assert not (tmp_path / "node").exists()


def test_a_recording_without_the_node_is_refused(tmp_path: Path) -> None:
    path = rewritten(tmp_path / "run.mcap", lambda topic, document: topic != "node/2/measurement")
    with pytest.raises(InputError, match='has no step of node "2" and its measurement below 200'):
        export(Gains.load(LOSSY), "2", tmp_path / "node", recording=path)


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "node_1_selftest.c").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        export(Gains.load(LOSSY), "1", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["node_1_selftest.c"]
    export(Gains.load(LOSSY), "1", tmp_path, force=True)
    assert len(list(tmp_path.iterdir())) == 4


def test_gains_beyond_float_are_refused(tmp_path: Path) -> None:
    gains = Gains.load(large(tmp_path / "large.json"))
    with pytest.raises(InputError, match=r"is beyond float; leave --float out"):
        export(gains, "n1", tmp_path / "node", single=True)
    assert not (tmp_path / "node").exists()
