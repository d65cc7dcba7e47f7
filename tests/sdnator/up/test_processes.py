"""How many processes `sdnator up` runs of an app is checked before anything starts."""

import pytest

from sdnator.errors import BadInput
from sdnator.up.planning import Given, plan_for


def planned(folder, text):
    file = folder / "sdnator.toml"
    file.write_text(text)
    return plan_for(Given(config=file, archive=f"sqlite://{folder}/a.db", dashboard=False), folder)


def test_apps_that_divide_the_switches_may_have_several(tmp_path):
    plan = planned(
        tmp_path,
        "[up]\nprocesses = { p4runtime_ctrl = 3, kitsune = 2, firewall = 1 }\n"
        '[p4runtime_ctrl]\ninstances = "sharded"\n[kitsune]\ninstances = "sharded"',
    )
    assert [part for part in plan.parts() if plan.app_of(part) in ("p4runtime_ctrl", "kitsune")] == [
        *("p4runtime_ctrl", "p4runtime_ctrl-2", "p4runtime_ctrl-3"),
        *("kitsune", "kitsune-2"),
    ]


@pytest.mark.parametrize(
    ("app", "said"),
    [
        ("p4runtime_ctrl", r'p4runtime_ctrl = 2.* set instances = "sharded" in \[p4runtime_ctrl\]'),
        ("firewall", "only instances that divide the switches all work"),
        ("coordinator", "the pipeline runs no app 'coordinator'"),
        ("kitsun", "the pipeline runs no app 'kitsun'"),
    ],
)
def test_others_may_not(tmp_path, app, said):
    with pytest.raises(BadInput, match=said):
        planned(tmp_path, f"[up]\nprocesses = {{ {app} = 2 }}")
