"""Suites: what a TOML file turns into, and what is refused before anything starts."""

from __future__ import annotations

import importlib
import json
from collections import Counter

import pytest
import tyro

from harness.schema import SUITES, SuiteError, suite_names
from harness.statistics import smallest_n
from harness.suite import load_suite


def test_every_algorithm_task_seed_and_agent_is_a_run(suite):
    assert len(suite.runs) == 2 * 2 * 2 * 2
    assert len({run.run_id for run in suite.runs}) == len(suite.runs)
    assert suite.runs[0].run_id == "ppo__Hopper__s1__a0"
    assert suite.timesteps == 16 * 200


def test_the_hash_is_of_the_configuration(suite, suite_file):
    assert len({run.hash for run in suite.runs}) == len(suite.runs)
    assert load_suite(str(suite_file)).runs[3].hash == suite.runs[3].hash
    assert load_suite(str(suite_file), total_timesteps=300).runs[3].hash != suite.runs[3].hash


@pytest.mark.parametrize("name", suite_names())
def test_flags_say_to_the_baseline_what_the_suite_says(name):
    for run in load_suite(name).runs[::7]:
        args_of = importlib.import_module(f"baselines.{run.baseline}").Args
        args = tyro.cli(args_of, args=run.flags)
        expected = args_of(
            **{k: tuple(v) if isinstance(v, list) else v for k, v in run.args.items()}
        )
        assert args == expected


def test_flags_of_booleans_and_lists(suite_file):
    text = suite_file.read_text().replace(
        "num_steps = 100",
        "num_steps = 100\nnorm_obs = false\nanneal_lr = true\nhidden_sizes = [8, 4]",
    )
    suite_file.write_text(text)
    run = load_suite(str(suite_file)).runs[0]
    args = tyro.cli(importlib.import_module(f"baselines.{run.baseline}").Args, args=run.flags)
    assert (args.norm_obs, args.anneal_lr, args.hidden_sizes) == (False, True, (8, 4))


def test_it_scales_down(suite_file):
    suite = load_suite(str(suite_file), total_timesteps=100, seeds=1, agents=1, env=("Reacher",))
    assert [run.run_id for run in suite.runs] == [
        "ppo__Reacher__s1__a0",
        "ppo-reg__Reacher__s1__a0",
    ]
    assert suite.timesteps == 200


@pytest.mark.parametrize("flag", ["total_timesteps", "seeds", "agents"])
def test_counts_start_at_1(suite_file, flag):
    with pytest.raises(SuiteError, match=f"{flag} must be at least 1, got 0"):
        load_suite(str(suite_file), **{flag: 0})


@pytest.mark.parametrize(
    ("own", "count", "taken"),
    [
        ("[1, 2]", 1, [1]),
        ("[1, 2]", 2, [1, 2]),
        ("[1, 2]", 4, [1, 2, 3, 4]),
        ("[7, 3]", 4, [7, 3, 8, 9]),
    ],
)
def test_more_seeds_follow_the_largest_of_the_suites_own(suite_file, own, count, taken):
    suite_file.write_text(suite_file.read_text().replace("[1, 2]", own))
    suite = load_suite(str(suite_file), seeds=count, agents=1, env=("Hopper",))
    seeds = [run.args["seed"] for run in suite.runs if run.algorithm == "PPO"]
    assert seeds == taken
    assert len(suite.runs) == 2 * count


def test_table1_is_the_papers_plan():
    suite = load_suite("table1")
    assert len(suite.environments) == 8
    assert {run.args["total_timesteps"] for run in suite.runs} == {5_000_000}
    for algorithm in suite.algorithms:
        runs = [r for r in suite.runs if (r.algorithm, r.environment) == (algorithm, "Ant")]
        assert len({(r.args["seed"], r.args["agent"]) for r in runs}) == 30


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("num_steps", "num_stesp", "argument 'num_stesp' is unknown: num_steps?"),
        ('title = "Tiny"', 'titel = "Tiny"', "key 'titel' is unknown: title?"),
        ("num_minibatches = 2", "num_minibatches = 3", "num_minibatches must divide"),
        ("num_minibatches = 2", 'num_minibatches = "2"', "num_minibatches must be .*int.*got '2'"),
        (
            "num_minibatches = 2",
            "num_minibatches = true",
            "num_minibatches must be .*int.*got True",
        ),
        ("coefficient = 0.0", "coefficient = -1.0", "coefficient must be finite and at least 0"),
        ("Pendulum-v1", "Pendulum-v7", "Pendulum"),
        ('"ppo_reg"\nargs', '"ppo"\nargs', "baseline 'ppo' cannot be imported"),
        ("[args]", "[args", "not valid TOML"),
        ("agents = 2\n", "", "needs the key 'agents'"),
        ("[1, 2]", "[]", "seeds must not be empty"),
        ("agents = 2", "agents = 0", "no runs"),
        ("[1, 2]", "[1, 1]", "must differ"),
        ("[1, 2]", "[-1]", "seed must be at least 0, got -1"),
        ("[1, 2]", "1", "seeds must be of type .*got 1"),
        ("agents = 2", 'agents = "2"', "agents must be of type .*got '2'"),
        ("total_timesteps = 200\n", "", "args needs total_timesteps"),
        (
            "args = { coefficient",
            "arg = { coefficient",
            "algorithm: key 'arg' is unknown: args?",
        ),
        ('name = "PPO reg"\n', "", "algorithm needs the key 'name'"),
        ('name = "PPO reg"', 'name = "PPO"', "must differ"),
        (
            "num_steps = 100",
            'num_steps = 100\nactivation = "gelu"',
            "activation must be .*tanh.*relu.*got 'gelu'",
        ),
        ("coefficient = 0.0", "coefficient = 0.0, cg_steps = 5", "argument 'cg_steps' is unknown"),
    ],
)
def test_a_bad_suite_is_refused_and_the_reason_told(suite_file, old, new, message):
    assert old in suite_file.read_text()
    suite_file.write_text(suite_file.read_text().replace(old, new))
    with pytest.raises(SuiteError, match=message):
        load_suite(str(suite_file))


def test_unknown_names_are_refused(suite_file):
    with pytest.raises(SuiteError, match=r"no suite 'tabel1': there are .*table1"):
        load_suite("tabel1")
    with pytest.raises(SuiteError, match=r"no file tabel1\.toml"):
        load_suite("tabel1.toml")
    with pytest.raises(SuiteError, match=r"environment 'Hoper' is unknown: Hopper\?"):
        load_suite(str(suite_file), env=("Hoper",))


SWEEP = """
[[sweeps]]
name = "size of delta"
baseline = "ppo_reg"
parameter = "radius"
values = [0.1, 2]
args = { coefficient = 0.01 }
environments = ["Reacher"]

[environments]
"""
FIGURES = """
[figures]
"Both" = ["PPO", "PPO reg"]

[environments]
"""


def added(suite_file, part: str) -> str:
    """The name of the suite, with a part more."""
    text = suite_file.read_text()
    assert text.count("[environments]\n") == 1
    suite_file.write_text(text.replace("[environments]\n", part))
    return str(suite_file)


def test_a_sweep_is_an_algorithm_for_each_value(suite_file):
    suite = load_suite(added(suite_file, SWEEP))
    names = ["size of delta=0.1", "size of delta=2"]
    assert suite.algorithms == ["PPO", "PPO reg", *names]
    assert suite.sweeps == {"size of delta": dict(zip([0.1, 2], names, strict=True))}
    runs = [run for run in suite.runs if run.algorithm in names]
    assert len(runs) == 2 * 2 * 2  # values, seeds, agents
    assert {run.environment for run in runs} == {"Reacher"}
    assert [run.args["radius"] for run in runs] == [0.1] * 4 + [2] * 4
    assert {run.args["coefficient"] for run in runs} == {0.01}
    assert runs[0].run_id == "size-of-delta-0-1__Reacher__s1__a0"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"radius"', '"raduis"', "argument 'raduis' is unknown: radius?"),
        ("values = [0.1, 2]", "values = [0.1, -2]", "size of delta=-2 on Reacher: radius must be"),
        ("values = [0.1, 2]", "", "sweep needs the key 'values'"),
        ("values = [0.1, 2]", "values = [0.1, 0.1]", "values must differ"),
        ("values = [0.1, 2]", "values = [2, 2.0]", "values must differ"),
        ("values = [0.1, 2]", "values = 0.1", r"values must be a list of plain values, got 0\.1"),
        ("values = [0.1, 2]", "values = [[1], [2]]", "values must be a list of plain values"),
        ("values = [0.1, 2]", "vlaues = [0.1, 2]", "key 'vlaues' is unknown: values?"),
        ('["Reacher"]', '["Raecher"]', "environment 'Raecher' is unknown: Reacher?"),
    ],
)
def test_a_bad_sweep_is_refused_and_the_reason_told(suite_file, old, new, message):
    assert old in SWEEP
    with pytest.raises(SuiteError, match=message):
        load_suite(added(suite_file, SWEEP.replace(old, new)))


def test_a_sweep_does_not_displace_another_of_its_name(suite_file):
    two = SWEEP.replace("[environments]\n", SWEEP.replace("[0.1, 2]", "[3]"))
    with pytest.raises(SuiteError, match=r"names of sweeps .* must differ"):
        load_suite(added(suite_file, two))


def test_an_algorithm_runs_on_its_own_environments_only(suite_file):
    text = suite_file.read_text().replace(
        'name = "PPO reg"\n', 'name = "PPO reg"\nenvironments = ["Reacher"]\n'
    )
    suite_file.write_text(text)
    runs = load_suite(str(suite_file)).runs
    assert Counter((run.algorithm, run.environment) for run in runs) == {
        ("PPO", "Hopper"): 4,
        ("PPO", "Reacher"): 4,
        ("PPO reg", "Reacher"): 4,
    }
    hopper = load_suite(str(suite_file), env=("Hopper",))
    assert {run.algorithm for run in hopper.runs} == {"PPO"}


def test_figures_name_the_algorithms_in_them(suite_file):
    assert load_suite(str(suite_file)).figures == {}
    assert load_suite(added(suite_file, FIGURES)).figures == {"Both": ["PPO", "PPO reg"]}


@pytest.mark.parametrize(
    ("named", "message"),
    [
        ('["PPO", "PPO rag"]', "algorithm 'PPO rag' is unknown: PPO reg?"),
        ('"PPO"', "figure 'Both' must list algorithms, got 'PPO'"),
        ("3", "figure 'Both' must list algorithms, got 3"),
    ],
)
def test_a_bad_figure_is_refused_and_the_reason_told(suite_file, named, message):
    with pytest.raises(SuiteError, match=message):
        load_suite(added(suite_file, FIGURES.replace('["PPO", "PPO reg"]', named)))


@pytest.mark.parametrize("name", suite_names())
def test_every_suite_that_is_shipped_loads(name):
    suite = load_suite(name)
    assert suite.name == name
    assert {run.environment for run in suite.runs} == set(suite.environments)
    assert {run.algorithm for run in suite.runs} == set(suite.algorithms)


SUITES_OF_LEVELS = ("smoke_coinrun", "table2", "themes")


def test_the_shipped_suites_are_those_of_the_study():
    control = ["ablation", "ablation_delta", "figure1", "first", "smoke", "strong", "table1"]
    control += ["rivals", "rivals_search"]
    assert suite_names() == sorted([*control, *SUITES_OF_LEVELS, "figure4", "paper"])


@pytest.mark.parametrize("name", ["table1", "strong"])
def test_a_suite_that_compares_has_the_agents_that_a_verdict_needs(name):
    runs = Counter((run.environment, run.algorithm) for run in load_suite(name).runs)
    tasks = len(load_suite(name).environments)
    assert min(runs.values()) >= smallest_n(1 / (2 * tasks))  # two contrasts on each task


@pytest.mark.parametrize("name", ["smoke", "strong", "table1"])
def test_the_four_algorithms_of_the_paper_differ_by_baseline_and_coefficient(name):
    runs = {r.algorithm: r for r in load_suite(name).runs if "levels" not in r.evaluation}
    for plain, regularized in (("PPO", "PPO reg"), ("TRPO", "TRPO reg")):
        assert runs[plain].baseline == runs[regularized].baseline == f"{plain.lower()}_reg"
        without = {k: v for k, v in runs[plain].args.items() if k != "coefficient"}
        assert without == runs[regularized].args
        assert runs[plain].args["coefficient"] == 0


def test_the_papers_cheetah_falls_and_the_zoos_plays_on():
    tasks = {
        name: {r.args["env_id"] for r in load_suite(name).runs if r.environment == "HalfCheetah"}
        for name in ("table1", "smoke", "strong")
    }
    module = "harness.envs.fast_bullet"
    falls, plays_on = (
        f"{module}:FastHalfCheetahPyBulletEnv-v0",
        f"{module}:FastHalfCheetahBulletEnv-v0",
    )
    assert tasks.pop("strong") == {plays_on}
    assert set(map(tuple, tasks.values())) == {(falls,)}


def test_figure1_is_four_settings_of_plain_ppo_on_four_tasks():
    suite = load_suite("figure1")
    assert suite.environments == ["Humanoid", "Hopper", "Ant", "Reacher"]
    assert len(suite.algorithms) == 4
    assert {run.baseline for run in suite.runs} == {"ppo_reg"}
    assert {run.args["coefficient"] for run in suite.runs} == {0}
    assert list(suite.figures.values()) == [suite.algorithms]
    assert "ours" in next(iter(suite.figures))  # the worse settings are not the paper's


def test_figure1s_worse_settings_are_those_of_docs_paper_md():
    expected = {
        "PPO": {},
        "PPO setting 2": {"gae_lambda": 0.5, "gamma": 0.95},
        "PPO setting 3": {"vf_learning_rate": 1e-5, "vf_epochs": 1},
        "PPO setting 4": {"gae_lambda": 0.0, "gamma": 0.8, "vf_learning_rate": 1e-2},
    }
    found = arms("figure1")
    assert list(found) == list(expected)
    for name, settings in expected.items():
        assert found[name] == [{"coefficient": 0.0, **settings}] * 4 * 3  # tasks, seeds
    assert "(2) λ 0.5, γ 0.95; (3) critic's step size 1e-5, 1 epoch; (4) λ 0, γ 0.8, critic's" in (
        SUITES.parents[1] / "docs" / "paper.md"
    ).read_text(encoding="utf-8")


def test_table1_is_the_standard_settings():
    assert arms("table1") == {
        name: [{"coefficient": 0.0} if name in ("PPO", "TRPO") else {}] * 8 * 3
        for name in ("PPO", "PPO reg", "TRPO", "TRPO reg")
    }
    counts = Counter((run.args["seed"], run.args["agent"]) for run in load_suite("table1").runs)
    assert counts == dict.fromkeys([(s, a) for s in (1, 2, 3) for a in range(10)], 4 * 8)


def test_strong_is_rl_baselines3_zoos_tuning():
    """Of its ppo.yml and trpo.yml: minibatches of 128, and what is said in the suite's comments."""
    suite = load_suite("strong")
    assert {run.args["total_timesteps"] for run in suite.runs} == {2_000_000}
    found = arms("strong")
    ppo = {
        "num_envs": 16, "num_steps": 512, "num_minibatches": 16 * 512 // 128, "update_epochs": 20,
        "vf_epochs": 20, "learning_rate": 3e-5, "vf_learning_rate": 3e-5, "gae_lambda": 0.9,
        "clip_coef": 0.4, "hidden_sizes": [256, 256], "activation": "relu",
    }  # fmt: skip
    trpo = {
        "num_envs": 2, "num_steps": 1024, "num_minibatches": 2 * 1024 // 128, "cg_steps": 25,
        "vf_epochs": 20, "vf_learning_rate": 1e-3,
    }  # fmt: skip
    for name, settings in (("PPO", ppo), ("TRPO", trpo)):
        assert found[f"{name} reg"] == [settings] * 8 * 3
        assert found[name] == [{"coefficient": 0.0, **settings}] * 8 * 3


def test_smoke_holds_trpo_and_the_settings_of_figure_1():
    smoke, figure1 = load_suite("smoke"), load_suite("figure1")
    assert {"TRPO", "TRPO reg"} <= set(smoke.algorithms)
    assert smoke.environments == [*load_suite("table1").environments, "CoinRun"]

    def settings_of(suite):
        changed = ("gae_lambda", "gamma", "vf_coef", "vf_learning_rate", "vf_epochs", "coefficient")
        return {
            (run.algorithm, run.environment): {k: v for k, v in run.args.items() if k in changed}
            for run in suite.runs
            if run.algorithm in figure1.algorithms and run.environment in figure1.environments
        }

    assert settings_of(smoke) == settings_of(figure1)
    assert smoke.figures.items() >= figure1.figures.items()


def arms(name: str) -> dict[str, list[dict]]:
    """What each algorithm of a suite sets, on each of its tasks, beyond what all have."""
    found: dict[str, list[dict]] = {}
    common = {"env_id", "seed", "agent", "total_timesteps", "log_spectrum"}
    for run in load_suite(name).runs:
        own = {k: v for k, v in run.args.items() if k not in common}
        if run.args["agent"] == 0:
            found.setdefault(run.algorithm, []).append(own)
    return found


def test_the_ablation_has_an_arm_for_each_question():
    found = arms("ablation")
    assert found["PPO"] == [{"coefficient": 0.0}] * 4
    assert list(load_suite("ablation").sweeps["coefficient"]) == [1e-3, 1e-2, 1e-1, 1.0]
    assert found["printed sign"] == [{"coefficient": 0.1, "printed_sign": True}] * 4
    assert found["per batch"] == [{"coefficient": 0.1, "reduction": "batch"}] * 4
    assert found["PPO, gain 1"] == [{"coefficient": 0.0, "output_gain": 1.0}] * 4
    assert found["PPO reg, gain 1"] == [{"coefficient": 0.1, "output_gain": 1.0}] * 4
    at_median = found["upper clamp at median J"]
    at_half = found["upper clamp at half of it"]
    assert [arm["lambda_min"] for arm in (*at_median, *at_half)] == [0.0] * 6
    assert [2 * arm["lambda_max"] for arm in at_half] == [arm["lambda_max"] for arm in at_median]


def test_kinds_of_delta_are_compared_at_one_length_and_noise_without_a_penalty():
    suite = load_suite("ablation_delta")
    found = arms("ablation_delta")
    kinds = [found[name] for name in suite.sweeps["kind of delta"].values()]
    assert all("radius" not in arm for of_kind in kinds for arm in of_kind)
    noise = [found[name] for name in suite.sweeps["noise augmentation"].values()]
    assert all(
        (arm["coefficient"], arm["perturb_obs"]) == (0.0, True) for of in noise for arm in of
    )


def test_an_evaluation_is_of_every_run_and_not_in_its_hash(tmp_path):
    path, text = tmp_path / "tiny.toml", (SUITES / "smoke_coinrun.toml").read_text()
    asked = "[evaluation]\nlevels = 2\nrepeats = 2\n"
    assert asked in text
    path.write_text(text.replace(asked, ""))
    plain = load_suite(str(path)).runs
    path.write_text(text.replace("levels = 2", "levels = 3"))
    evaluated = load_suite(str(path)).runs
    assert all(run.evaluation == {"levels": 3, "repeats": 2, "unseen": "next"} for run in evaluated)
    assert all(run.evaluation == {} for run in plain)
    assert [run.args for run in plain] == [run.args for run in evaluated]
    assert [run.hash for run in plain] == [run.hash for run in evaluated]


def including(tmp_path, names, own: str = "", name: str = "union") -> str:
    path = tmp_path / f"{name}.toml"
    path.write_text(f'title = "Union"\ninclude = {json.dumps(list(map(str, names)))}\n{own}')
    return str(path)


@pytest.fixture
def other_file(tmp_path, suite_file):
    """Shares PPO on Hopper with the tiny suite; TRPO, and Walker2D, are its own."""
    path, text = tmp_path / "other.toml", suite_file.read_text()
    text = text.replace('name = "PPO reg"\nbaseline = "ppo_reg"', TRPO_ALGORITHM)
    path.write_text(text.replace("Reacher = ", "Walker2D = "))
    return path


TRPO_ALGORITHM = 'name = "TRPO"\nbaseline = "ppo_reg"\nargs = { coefficient = 0.5 }'


def test_included_suites_are_one_union_of_runs_each_in_its_own_folder(
    tmp_path, suite_file, other_file
):
    suite = load_suite(including(tmp_path, [suite_file, other_file]))
    assert (suite.name, suite.title, suite.note) == ("union", "Union", "")
    assert suite.algorithms == ["PPO", "PPO reg", "TRPO"]
    assert suite.environments == ["Hopper", "Reacher", "Walker2D"]
    first, second = load_suite(str(suite_file)), load_suite(str(other_file))
    shared = [r for r in second.runs if (r.algorithm, r.environment) == ("PPO", "Hopper")]
    assert len(shared) == 4
    assert suite.runs == first.runs + [run for run in second.runs if run not in shared]
    assert Counter(run.suite for run in suite.runs) == {"tiny": 16, "other": 12}


def test_a_suites_own_runs_come_before_those_that_it_includes(tmp_path, suite_file, other_file):
    other_file.write_text('include = ["' + str(suite_file) + '"]\n' + other_file.read_text())
    suite = load_suite(str(other_file))
    assert suite.name == "other"
    assert Counter(run.suite for run in suite.runs) == {"other": 16, "tiny": 12}
    ppo_on_hopper = [r for r in suite.runs if (r.algorithm, r.environment) == ("PPO", "Hopper")]
    assert {run.suite for run in ppo_on_hopper} == {"other"}


def test_a_union_scales_down_in_all_its_parts(tmp_path, suite_file, other_file):
    name = including(tmp_path, [suite_file, other_file])
    small = load_suite(name, total_timesteps=300, seeds=1, agents=1, env=("Walker2D", "Hopper"))
    assert [run.run_id for run in small.runs] == [
        "ppo__Hopper__s1__a0",
        "ppo-reg__Hopper__s1__a0",
        "ppo__Walker2D__s1__a0",
        "trpo__Hopper__s1__a0",
        "trpo__Walker2D__s1__a0",
    ]
    assert small.timesteps == 5 * 300
    assert small.environments == ["Hopper", "Walker2D"]
    assert {run.suite for run in load_suite(name, env=("Walker2D",)).runs} == {"other"}
    with pytest.raises(SuiteError, match=r"environment 'Walker' is unknown: Walker2D\?"):
        load_suite(name, env=("Walker",))


def test_figures_and_sweeps_of_included_suites_are_there(tmp_path, suite_file, other_file):
    added(suite_file, FIGURES)
    added(other_file, SWEEP.replace('"Reacher"', '"Walker2D"'))
    suite = load_suite(including(tmp_path, [suite_file, other_file]))
    assert suite.figures == {"Both": ["PPO", "PPO reg"]}
    assert list(suite.sweeps) == ["size of delta"]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("num_steps = 100", "num_steps = 200"),  # other arguments: other runs of the same name
        ('name = "TRPO"', 'name = "PPO-reg"'),  # another algorithm, whose runs are named alike
    ],
)
def test_two_runs_of_one_name_are_refused(tmp_path, suite_file, other_file, old, new):
    assert old in other_file.read_text()
    other_file.write_text(other_file.read_text().replace(old, new))
    with pytest.raises(SuiteError, match=r"union\.toml: names .* must differ"):
        load_suite(including(tmp_path, [suite_file, other_file]))


@pytest.mark.parametrize("own", ["", "as the tiny suite"])
def test_what_includes_others_is_not_included(tmp_path, suite_file, other_file, own):
    """Its own runs alone would pass for all of it."""
    inner = including(tmp_path, [other_file], own, "inner") if not own else str(suite_file)
    if own:
        suite_file.write_text(f'include = ["{other_file}"]\n{suite_file.read_text()}')
    with pytest.raises(SuiteError, match=r"union\.toml includes \w+, which includes others"):
        load_suite(including(tmp_path, [inner]))


def test_an_unknown_suite_is_not_included(tmp_path):
    with pytest.raises(SuiteError, match="no suite 'tabel1'"):
        load_suite(including(tmp_path, ["tabel1"]))
    with pytest.raises(SuiteError, match=r"union\.toml has no runs"):
        load_suite(including(tmp_path, []))


@pytest.mark.parametrize(
    "name", ["ablation", "ablation_delta", "figure1", "rivals", "rivals_search", "strong", "table1"]
)
def test_every_control_agent_is_evaluated_over_20_episodes(name):
    assert all(run.evaluation == {"episodes": 20} for run in load_suite(name).runs)


def test_themes_trains_with_and_without_the_penalty_on_one_theme_of_each_kind():
    suite = load_suite("themes")
    assert [run.run_id for run in suite.runs] == [
        f"{agent}__CoinRun__s{seed}__a0" for agent in ("ppo", "ppo-reg") for seed in (1, 2, 3)
    ]
    asked = {"levels": 500, "repeats": 5, "unseen": "themes"}
    assert all(run.evaluation == asked for run in suite.runs)
    assert all(run.args["restrict_themes"] for run in suite.runs)
    assert [run.args.get("coefficient") for run in suite.runs] == [0.0] * 3 + [None] * 3


def test_table2_is_the_papers_plan():
    suite = load_suite("table2")
    assert suite.environments == ["CoinRun"]
    assert len(suite.runs) == 8
    assert {run.args["total_timesteps"] for run in suite.runs} == {50_000_000}
    assert all(
        run.evaluation == {"levels": 500, "repeats": 20, "unseen": "next"} for run in suite.runs
    )
    assert [run.run_id for run in load_suite("table2", seeds=3).runs[:3]] == [
        "ppo__CoinRun__s1__a0",
        "ppo__CoinRun__s2__a0",
        "ppo__CoinRun__s3__a0",
    ]


@pytest.mark.parametrize("name", ["table2", "smoke_coinrun"])
def test_the_eight_agents_are_four_with_and_without_the_penalty(name):
    runs = {run.algorithm: run for run in load_suite(name).runs}
    plain = {a: {} for a in ("PPO", "PPO-l2", "PPO-D", "PPO-IMP")}
    plain["PPO-l2"], plain["PPO-D"] = {"l2": 1e-4}, {"dropout": 0.1}
    plain["PPO-IMP"] = {"network": "impala"}
    common = [k for k in runs["PPO"].args if k != "coefficient"]
    for algorithm, special in plain.items():
        without, reg = runs[algorithm].args, runs[f"{algorithm} reg"].args
        assert without == reg | {"coefficient": 0.0}
        assert "coefficient" not in reg
        assert {k: v for k, v in reg.items() if k not in common} == special
    assert list(runs) == [x for a in plain for x in (a, f"{a} reg")]


def test_the_paper_is_both_tables_and_figure_1_each_run_once():
    paper = load_suite("paper")
    assert len(paper.runs) == 1328  # 960, 360 of the settings 2 to 4 of figure 1, and 8
    assert Counter(run.suite for run in paper.runs) == {"table1": 960, "figure1": 360, "table2": 8}
    parts = [load_suite(name) for name in ("table1", "figure1", "table2")]
    hashes = {run.hash for part in parts for run in part.runs}
    assert {run.hash for run in paper.runs} == hashes
    assert len(hashes) == 1328
    assert paper.figures == parts[0].figures | parts[1].figures
    assert load_suite("paper", env=("CoinRun",)).runs == parts[2].runs


def test_the_runs_of_figure4_are_table2s():
    assert load_suite("figure4").runs == load_suite("table2").runs


def test_smoke_holds_the_eight_agents_of_coinrun():
    runs = [run for run in load_suite("smoke").runs if run.environment == "CoinRun"]
    assert runs == load_suite("smoke_coinrun").runs
    assert {run.suite for run in runs} == {"smoke_coinrun"}
    assert [run.algorithm for run in runs] == load_suite("table2").algorithms


def test_every_rival_is_compared_and_has_the_same_search():
    compared = {
        run.args.get("penalty", "conditioning"): run.args["coefficient"]
        for run in load_suite("rivals").runs
        if run.args["coefficient"] > 0
    }
    assert compared.keys() == {"conditioning", "jacobian", "caps", "lcp", "l2c2", "sa", "spectral"}
    searched: dict[str, set[float]] = {}
    for run in load_suite("rivals_search").runs:
        name = run.args.get("penalty", "conditioning")
        searched.setdefault(name, set()).add(run.args["coefficient"])
    assert searched.keys() == compared.keys()
    for name, coefficients in searched.items():
        low, middle, high = sorted(coefficients)
        assert (low * 10, middle * 10) == pytest.approx((middle, high))
        assert compared[name] in coefficients
