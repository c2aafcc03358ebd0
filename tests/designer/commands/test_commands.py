"""The program's commands: what they print, what they write, how they refuse."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from made_recordings import record, simulate
from networks import random_problem
from places import ROOT

from agent.contract.gains import Gains
from agent.contract.problem import Problem
from designer.cli import main
from designer.commands import design as design_command
from designer.commands.verify import _differences
from designer.problems import find, names
from designer.replay.gamma import checked_gamma
from designer.reproduce import EXAMPLES, Reproduced
from designer.search import effort, windows
from designer.search.descent import Progress, descend
from designer.search.starts import least_variance_gains
from designer.synthesis import methods


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which is also where the commands run."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


# Good input.
def test_design_verify_show(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A design can be verified and shown, and says the same facts as text and as JSON."""
    assert run("design", "two-nodes", "-o", "gains.json", "--json") == 0
    designed = json.loads(capsys.readouterr().out)
    assert designed["method"] == "exact"  # the default for a problem this small
    promised = {"problem", "method", "gamma", "lmi_gamma", "exact", "floor", "holds", "seconds", "output"}
    assert promised <= designed.keys()
    assert designed["holds"] is True
    assert "total" in designed["seconds"]
    assert run("verify", "gains.json", "--json") == 0
    verified = json.loads(capsys.readouterr().out)
    assert {"holds", "gamma", "arithmetic", "failure"} <= verified.keys()
    assert (verified["holds"], verified["gamma"]) == (True, designed["gamma"])
    assert run("show", "gains.json") == 0
    assert f"{designed['gamma']:.5f}"[:6] in capsys.readouterr().out
    assert run("design", "two-nodes", "-o", "gains.json") == 2
    assert "exists already" in capsys.readouterr().err
    assert run("design", "two-nodes", "-o", "gains.json", "--force", "--method", "decomposed") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("two-nodes by decomposed: gamma = 1.41421")
    assert "ladder     1.414213  floor\n" in printed


def test_verify_says_of_which_problem(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """gamma of another plant under a famous name is proved, and the name is not lent to it."""
    assert run("design", "two-nodes", "-o", "true.json") == 0
    text = (ROOT / "designer" / "problems" / "two-nodes.toml").read_text()
    first = next(line for line in text.splitlines() if line.startswith("M = "))
    Path("other.toml").write_text(text.replace(first, "M = [[0.5]]"))
    assert run("design", "other.toml", "-o", "false.json") == 0
    capsys.readouterr()
    assert run("verify", "true.json", "two-nodes") == 0
    printed = capsys.readouterr().out
    assert "of      two-nodes, digest " in printed
    assert "NOT" not in printed
    assert run("verify", "false.json") == 0
    assert "NOT the built-in one of the name two-nodes" in capsys.readouterr().out
    assert run("show", "false.json") == 0
    assert "NOT the built-in problem of this name" in capsys.readouterr().out
    assert run("verify", "false.json", "two-nodes") == 1
    assert 'another problem than two-nodes: "plant" differs' in capsys.readouterr().out
    assert run("verify", "false.json", "two-nodes", "--json") == 1
    assert json.loads(capsys.readouterr().out)["holds"] is False
    assert run("verify", "false.json", "other.toml") == 0


def test_no_proof_depends_on_a_name_or_on_the_beginning(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """gamma is beside what an initial error leaves."""
    assert run("design", "two-nodes", "-o", "gains.json") == 0
    text = (ROOT / "designer" / "problems" / "two-nodes.toml").read_text()
    for changed, by, said in (
        ('name = "two-nodes"', 'name = "renamed"', '"name"'),
        ("[plant]\n", "[plant]\ninitial_error = [0.1]\n", '"initial_error"'),
    ):
        assert changed in text
        Path("other.toml").write_text(text.replace(changed, by, 1))
        capsys.readouterr()
        assert run("verify", "gains.json", "other.toml") == 0
        assert f"differs from the one given in {said}, on which this gamma does not depend" in capsys.readouterr().out


def test_of_which_problem_gamma_is() -> None:
    """It is from any first mode; a link that loses nothing is none, one that loses a little is one."""
    problem = random_problem(0, modes=2)
    other = next(name for name in problem.mode_names if name != problem.markov.initial)
    assert _differences(problem, problem.with_(markov={"initial": other})) == ["initial"]
    i = next(i for i in range(problem.n) if len(problem.ever_heard(i)) > 1)
    receiver, sender = problem.node_names[i], problem.node_names[next(j for j in problem.ever_heard(i) if j != i)]
    for probability, differs in ((1.0, []), (1.0 - 2.0**-53, ["link"])):
        link = {"receiver": receiver, "sender": sender, "delivery_probability": probability}
        assert _differences(problem, Problem.from_document(problem.document() | {"link": [link]})) == differs


def test_a_lower_end_that_is_false_leaves_gamma_proved(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is the file that is wrong, and says so; not gamma."""
    assert run("design", "two-nodes", "-o", "gains.json") == 0
    document = json.loads(Path("gains.json").read_text())
    low = document["certificate"]["exact"][0] = 1.001 * document["certificate"]["gamma"]
    Path("gains.json").write_text(json.dumps(document))
    capsys.readouterr()
    assert run("verify", "gains.json") == 1
    said = capsys.readouterr().out
    assert said.startswith(f"does not hold: gains.json says what is proved false: the exact gain is below {low}")
    assert f"gamma = {document['certificate']['gamma']} itself is proved" in said
    assert "gamma itself is proved" in checked_gamma(Gains.load(Path("gains.json"))).text()


@pytest.mark.parametrize("command", [("verify",), ("show",), ("analyse", "two-nodes", "--gains")])
def test_a_key_that_is_there_twice_is_refused(
    command: tuple[str, ...], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Readers of JSON take the first or the last of them, so nobody may be shown one and prove the other."""
    assert run("design", "two-nodes", "-o", "gains.json") == 0
    data = Path("gains.json").read_bytes()
    Path("twice.json").write_bytes(data.replace(b'"certificate":{', b'"certificate":{"gamma":0.001,', 1))
    assert run(*command, "twice.json") == 2
    assert "the key 'gamma' is there 2 times; keep one of them" in capsys.readouterr().err


def test_the_default_of_a_large_problem(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is searched in windows; where these are too large the decomposed LMI is solved, and a sentence says so."""
    monkeypatch.setattr(effort, "MOST_NODES", 1)
    assert run("design", "two-nodes", "-o", "gains.json") == 0
    assert capsys.readouterr().out.startswith("two-nodes by exact: gamma = 1.414")
    monkeypatch.setattr(windows, "_MOST", 1)
    assert run("design", "two-nodes", "-o", "gains.json", "--force", "--json") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["method"] == "decomposed"
    assert printed.err == (
        "method decomposed: of more than 1 nodes some hear too many others to be searched in windows; --method exact "
        "asks for a search of all at once\n"
    )


def test_what_there_is_when_time_is_over_is_certified(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A budget too short for one step leaves the gains that the search would have started from, and says so."""
    assert run("design", "two-nodes", "-o", "gains.json", "--budget", "0.000001s") == 0
    assert capsys.readouterr().err == "warning: the search was out of time after 0 steps; --budget gives it more\n"
    assert Gains.load(Path("gains.json")).solver.status.startswith("out of time; from ")
    assert run("verify", "gains.json") == 0


def test_what_an_estimate_may_miss_the_budget_bounds(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """How slowly errors decay at the least gain is not known beforehand; that the budget ends the search is."""
    for seconds, large, said in (
        ((40.0, 120.0, 180.0), 1e9, "40 seconds to 3 minutes here, about 2 minutes as a rule, the longer"),
        ((40.0, 1000.0, 180.0), 1e8, "40 seconds to 3 minutes here, the longer the more slowly"),
        ((180.0, 1000.0, 180.0), 1e8, "3 minutes here, the longer"),
    ):
        found = effort.Seconds(*seconds)
        monkeypatch.setattr(effort, "seconds_within", lambda problem, budget, found=found: found)
        monkeypatch.setattr(effort, "LARGE", large)
        assert run("design", "two-nodes", "-o", "gains.json", "--force", "--budget", "0.001s") == 0
        printed = capsys.readouterr().err
        assert printed.startswith(f"method exact: it takes {said}")
        assert ("; up to 0.2 GB of memory; " in printed) == (large == 1e8)


@pytest.mark.parametrize("text", ["0", "10 min", "1d", "-1s", "min"])
def test_a_budget_is_a_time(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        run("design", "two-nodes", f"--budget={text}")
    assert f'"{text}" is no time; write 90s, 10min or 2h' in capsys.readouterr().err


def test_what_if(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A network without a part is designed like any other; the price of every part comes as one table."""
    assert run("design", "two-nodes", "--without-node", "left", "--method", "decomposed", "--json") == 0
    designed = json.loads(capsys.readouterr().out)
    assert (designed["problem"], designed["output"]) == ("two-nodes-without-left", "two-nodes-without-left.gains.json")
    assert Gains.load(Path(designed["output"])).problem.node_names == ("right",)
    assert run("design", "two-nodes", "--price", "--method", "decomposed", "--json") == 0
    printed = capsys.readouterr()
    table = json.loads(printed.out)
    assert len(table["rows"]) == 4
    assert next(row["gamma"] for row in table["rows"] if row["name"] == "left") == pytest.approx(designed["gamma"])
    assert "   5 of 5 designs" in printed.err


def test_show_lists_the_built_in_problems(capsys: pytest.CaptureFixture[str]) -> None:
    """Without a file, show names every built-in problem."""
    assert run("show") == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in names())


def test_a_certificate_that_fails_is_an_answer(folder: Path, gains: Gains, capsys: pytest.CaptureFixture[str]) -> None:
    """Verify says no with exit code 1 and why, where a gamma is too small."""
    assert run("design", "two-nodes", "-o", "gains.json", "--method", "decomposed") == 0
    document = json.loads(Path("gains.json").read_text())
    document["certificate"]["gamma"] *= 1 - 1e-5
    Path("gains.json").write_text(json.dumps(document))
    capsys.readouterr()
    assert run("verify", "gains.json") == 1
    assert "does not hold: " in capsys.readouterr().out


def test_a_senseless_certificate_is_refused(folder: Path, gains: Gains, capsys: pytest.CaptureFixture[str]) -> None:
    """One sentence names the file, the place and what would be right; a horizon without end is not begun."""
    assert run("design", "two-nodes", "-o", "gains.json", "--method", "theorem2-reduced") == 0
    document = json.loads(Path("gains.json").read_text())
    document["certificate"] |= {"kind": "lyapunov", "theorem1_gamma": None}
    text = json.dumps(document)
    for edit, sentence in {
        ("gamma", 1e300): "edited.json: certificate: gamma: must be less than 1e+150, got 1e+300",
        ("gamma", 1e-300): "edited.json: certificate: gamma: must be greater than 1e-150, got 1e-300",
        ("horizon", 10**9): "edited.json: certificate: horizon is 1000000000; ",
        ("horizon", 0): "edited.json: certificate: horizon is 0; ",
        ("R", None): "edited.json: certificate: R is missing; it must be ",
        ("theorem1_gamma", -1.0): "edited.json: certificate: theorem1_gamma: must be greater than 1e-150, got -1.0",
        ("form", "summed"): 'edited.json: certificate: form "summed" has nothing stored for these errors, and no R',
    }.items():
        document = json.loads(text)
        document["certificate"][edit[0]] = edit[1]
        Path("edited.json").write_text(json.dumps(document))
        capsys.readouterr()
        assert run("verify", "edited.json") == 2
        assert capsys.readouterr().err.startswith(f"peakmesh: {sentence}")


def test_report_writes_beside_the_recording(folder: Path, gains: Gains, capsys: pytest.CaptureFixture[str]) -> None:
    """One page, which it does not replace unasked, and never in place of the recording."""
    record(Path("run.mcap"), gains, simulate(gains, steps=30), steps=30)
    assert run("report", "run.mcap", "--json") == 0
    done = json.loads(capsys.readouterr().out)
    assert done == {
        "recording": "run.mcap", "agrees": True, "outcome": "agrees", "report": "run.html", "figures": [], "data": [],
    }  # fmt: skip
    assert Path("run.html").read_text().startswith("<!doctype html>")
    assert run("report", "run.mcap") == 2
    assert "run.html exists already" in capsys.readouterr().err
    assert run("report", "run.mcap", "-o", "run.mcap", "--force") == 2
    assert "run.mcap is the recording itself" in capsys.readouterr().err
    assert run("report", "run.mcap", "-o", ".") == 2
    assert run("report", "run.mcap", "--force") == 0
    assert "report     run.html\nverdict    agrees" in capsys.readouterr().out


def test_report_writes_figures_and_tables(folder: Path, gains: Gains, capsys: pytest.CaptureFixture[str]) -> None:
    """Each at two widths, with the numbers behind each; the page where it is asked for."""
    record(Path("run.mcap"), gains, simulate(gains, steps=10), steps=10)
    assert run("report", "run.mcap", "--figures", "paper/run", "--format", "svg", "--data", "--json") == 0
    done = json.loads(capsys.readouterr().out)
    figures, data = (sorted(map(Path, done[key])) for key in ("figures", "data"))
    assert sorted(Path("paper/run").iterdir()) == sorted([*figures, *data])
    assert len(figures) == 2 * len(data) > 10
    assert {path.name.partition(".")[2] for path in figures} == {"svg"}
    assert {path.stem.removesuffix("-one-column").removesuffix("-two-columns") for path in figures} == {
        path.stem for path in data
    }
    assert not Path("run.html").exists()
    assert run("report", "run.mcap", "--figures", "paper/run", "--format", "svg", "-o", "page.html") == 2
    assert not Path("page.html").exists()
    assert run("report", "run.mcap", "--figures", "paper/run", "--format", "svg", "-o", "page.html", "--force") == 0
    assert Path("page.html").exists()


def test_report_refuses_in_a_sentence(folder: Path, gains: Gains, capsys: pytest.CaptureFixture[str]) -> None:
    """A run without a step, options that say nothing, and a folder that is a file; nothing is written."""
    empty = record(Path("run.mcap"), gains, [], steps=10, whole=False)
    there = sorted(folder.iterdir())
    for words, code, sentence in (
        ([empty], 3, "run.mcap.part holds no step of its run, so there is nothing to report"),
        ([empty, "--data"], 2, "--data says something of the figures; name a folder for them with --figures"),
        ([empty, "--format", "pdf"], 2, "--format says something of the figures; name a folder"),
        ([empty, "--figures", empty], 2, "run.mcap.part is a file; --figures takes a folder"),
        ([empty, "--figures", "new"], 3, "holds no step of its run"),
    ):
        assert run("report", *words) == code
        printed = capsys.readouterr()
        assert (printed.out, printed.err.count("\n")) == ("", 1)
        assert sentence in printed.err
    assert sorted(folder.iterdir()) == there


def test_reproduce_writes_the_papers_figures(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """2 to 6, at two widths; what is in the way is refused before anything is computed."""
    golden = Gains.load(ROOT / "recordings" / "golden" / "zhu2020-lossy.gains.json")

    def made(**_: object) -> Reproduced:
        computed = {name: SimpleNamespace(theorem2=golden) for name in EXAMPLES}
        return Reproduced({name: {} for name in EXAMPLES}, computed)  # type: ignore[arg-type]

    monkeypatch.setattr("designer.reproduce.reproduce", made)
    assert run("reproduce", "--figures", "paper", "--format", "svg", "--json") == 0
    figures = sorted(json.loads(capsys.readouterr().out)["figures"])
    widths = ("one-column", "two-columns")
    assert figures == [f"paper/figure-{number}-{width}.svg" for number in range(2, 7) for width in widths]
    assert all(Path(path).stat().st_size > 1000 for path in figures)
    monkeypatch.setattr("designer.reproduce.reproduce", None)
    assert run("reproduce", "--figures", "paper", "--format", "svg") == 2
    assert "figure-2-one-column.svg exists already" in capsys.readouterr().err
    assert run("reproduce", "--format", "svg") == 2


# Bad input: every command that reads a file, with every wrong file.
WRONG_FILES = {
    "missing": None,
    "empty": b"",
    "text": b"hello\n",
    "binary": bytes(range(256)),
    "foreign.json": b'{"format": "something else"}',
    "truncated.json": b'{"format": "peakmesh-gains", "version": 1, "prob',
    "foreign.toml": b"[tool]\nname = 'x'\n",
    "truncated.toml": b"name = 'x'\n[plant]\nA = [[0.5",
    "truncated.mcap": b"\x89MCAP0\r\n\x01",
}
COMMANDS = {
    "design": ["design", "FILE", "-o", "out"],
    "demo": ["demo", "FILE", "-o", "out"],
    "analyse": ["analyse", "two-nodes", "--gains", "FILE"],
    "verify": ["verify", "FILE"],
    "run": ["run", "FILE", "-o", "out"],
    "node": ["node", "FILE", "--node", "1", "--connect", "tcp/127.0.0.1:1"],
    "plant": ["plant", "FILE", "--connect", "tcp/127.0.0.1:1"],
    "coordinator": ["coordinator", "FILE"],
    "recorder": ["recorder", "FILE", "-o", "out", "--connect", "tcp/127.0.0.1:1"],
    "replay": ["replay", "FILE"],
    "report": ["report", "FILE", "-o", "out"],
    "show": ["show", "FILE"],
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("wrong", WRONG_FILES)
def test_wrong_file(folder: Path, capsys: pytest.CaptureFixture[str], command: str, wrong: str) -> None:
    """A file that is not what the command reads: exit 2, one sentence that names it, nothing written."""
    content = WRONG_FILES[wrong]
    if content is not None:
        (folder / wrong).write_bytes(content)
    there = sorted(folder.iterdir())
    assert run(*(wrong if word == "FILE" else word for word in COMMANDS[command])) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("peakmesh: ")
    assert printed.err.count("\n") == 1
    assert wrong in printed.err
    assert sorted(folder.iterdir()) == there


@pytest.mark.parametrize("command", ["analyse", "verify", "run", "node", "plant", "coordinator", "recorder", "show"])
def test_edited_problem(folder: Path, gains: Gains, capsys: pytest.CaptureFixture[str], command: str) -> None:
    """Gains whose problem was edited afterwards are refused by every command that reads them."""
    document = json.loads(gains.canonical())
    document["problem"]["node"][0]["arrival_probability"] = 0.123
    Path("gains.json").write_text(json.dumps(document))
    assert run(*("gains.json" if word == "FILE" else word for word in COMMANDS[command])) == 2
    assert "the problem was edited afterwards; design the gains again" in capsys.readouterr().err


def test_wrong_words(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Unknown commands, methods and senseless numbers: exit 2."""
    monkeypatch.setattr("designer.workers.PATIENCE", 1)  # seconds for a Dask scheduler that is not there
    assert run() == 2
    assert "COMMAND" in capsys.readouterr().err
    for words in (["dance"], ["run", "two-nodes", "--steps", "0"], ["run", "two-nodes", "--seed", "-1"]):
        with pytest.raises(SystemExit) as caught:
            run(*words)
        assert caught.value.code == 2
    for words in (["--steps", "x"], ["--steps", "1.5"], ["--seed", "1e3"], ["--deadline", "soon"]):
        with pytest.raises(SystemExit):
            run("run", "two-nodes", *words)
        assert f"{words[1]} is not a" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        run("design", "--help")
    helped = capsys.readouterr().out
    assert all(f"{method} " in helped or f"{method}:" in helped for method in methods())
    assert run("design", "two-nodes", "--method", "magic", "-o", "never.json") == 2
    assert 'method "magic" does not exist; the methods are "theorem2"' in capsys.readouterr().err
    assert not Path("never.json").exists()
    for words, sentence in {
        ("--dask", "tcp://127.0.0.1:1"): "--dask spreads the many designs of --price, and the windows",
        ("--price", "--dask", "tcp://127.0.0.1:1"): "no Dask scheduler answers at tcp://127.0.0.1:1: ",
        ("--price", "-o", "never.json"): "--price writes no gains file",
        ("--without-link", "left"): "--without-link left: a link is A:B",
        ("--without-link", "left:left"): "a node always hears itself",
        ("--without-link", "left:middle"): 'node "middle" does not exist',
        ("--without-node", "middle"): 'node "middle" does not exist',
        ("--without-node", "left", "--without-node", "right"): "is the only node of two-nodes-without-left",
    }.items():
        assert run("design", "two-nodes", *words) == 2
        assert sentence in (said := capsys.readouterr().err)
        assert "designs, whole network" not in said


# The whole job, and what is kept of an old one.
def test_demo(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One command designs, runs, replays and reports the paper's second example; every file it names is there."""
    assert run("demo", "--steps", "50", "--json", "--method", "decomposed") == 0
    done = json.loads(capsys.readouterr().out)
    assert done["design"]["gamma"] == pytest.approx(done["design"]["ladder"]["exact"][1], rel=1e-9)
    assert done["design"]["gamma"] < 0.34797 < done["design"]["ladder"]["theorem1"] < 0.34801
    assert done["replay"]["agrees"]
    assert done["replay"]["finished"]
    files = [done["design"]["output"], done["run"]["recording"], done["report"]]
    assert [Path(file).name for file in files] == ["gains.json", "run.mcap", "report.html"]
    assert all(Path(file).is_file() for file in files)


def test_golden_recording(capsys: pytest.CaptureFixture[str]) -> None:
    """A recording of an earlier day still reads, and still agrees with the mathematics."""
    assert run("replay", ROOT / "recordings" / "golden" / "zhu2020-lossy.mcap", "--json") == 0
    verdict = json.loads(capsys.readouterr().out)
    assert (verdict["agrees"], verdict["finished"], verdict["steps"], verdict["missing"]) == (True, True, 60, 0)
    assert run("verify", ROOT / "recordings" / "golden" / "zhu2020-lossy.gains.json") == 0


def test_the_progress_of_a_design_says_how_much_is_done(capsys: pytest.CaptureFixture[str]) -> None:
    """Every other second of the search: its time and what it may take, its round of how many."""
    told: list[Progress] = []
    descend(two := find("two-nodes"), {"start": least_variance_gains(two)}, progress=told.append)
    told = [progress for progress in told if progress.phase is None]
    assert [progress.round for progress in told] == sorted(progress.round for progress in told)
    assert {progress.rounds for progress in told} == {told[-1].round}  # it has come to the last one
    show = design_command._descent_progress(600.0)
    for seconds, whole in ((1.0, 2.0), (2.5, 1000.0), (3.0, 4.0), (4.5, 40.0)):
        show(told[-1]._replace(seconds=seconds, whole=whole))
    said = capsys.readouterr().err.splitlines()
    assert [line.split(" at most, ")[0].strip() for line in said] == [
        "2 s of 10 minutes",
        f"4 s of about 40 seconds if {told[-1].horizon} steps are enough, 10 minutes",
    ]
    design_command._descent_progress(600.0, alone=False)(told[-1]._replace(seconds=4.5, whole=40.0))
    assert "about" not in capsys.readouterr().err
    assert f"round {told[-1].round} of {told[-1].rounds}, from start, " in said[0]
    assert said[0].endswith("; Ctrl-C keeps the best so far")
