"""Apps are found by entry point, and what does not fit is refused by name before anything starts."""

from importlib.metadata import EntryPoint

import msgspec
import pytest

from sdnator.app_catalogue import ENFORCERS, GROUP, OURS, apps, catalogued, to_run
from sdnator.errors import BadInput


class Package:
    """What an entry point knows of its package."""

    def __init__(self, name):
        self.name = name


def entry(name, module="their.service", package="theirs"):
    return EntryPoint(name, module, GROUP)._for(Package(package))


def test_our_own_apps_are_found_like_everybody_s():
    ours = [app for app in apps() if app.ours]
    assert tuple(app.name for app in ours) == OURS
    for app in ours:
        assert app.interests
        assert app.capabilities
        assert issubclass(app.settings, msgspec.Struct)
        assert app.service.__module__ == app.module


def test_enforcers_run_only_where_the_firewall_names_them():
    """Whoever installs the product changes no host's firewall by that."""
    assert not {*ENFORCERS} & {*to_run(("p4runtime_ctrl",))}
    assert "nftables" in to_run(("p4runtime_ctrl", "nftables"))
    for app in apps():
        if app.name in ENFORCERS:
            assert app.interests
            assert app.capabilities
    with pytest.raises(BadInput, match="no app 'iptables'"):
        to_run(("iptables",))


def test_others_follow_ours_by_name():
    found = catalogued([entry("zeta"), entry("alpha"), entry("firewall", "apps.firewall.service", "sdnator")])
    assert [app.name for app in found] == ["firewall", "alpha", "zeta"]


@pytest.mark.parametrize(
    ("entries", "fault"),
    [
        ([entry("up")], "a name of the product"),
        ([entry("kitsune")], "a name of the product"),
        ([entry("nftables")], "a name of the product"),
        ([entry("a.b")], "letters, digits"),
        ([entry("mine", "one.service", "one"), entry("mine", "two.service", "two")], "both bring"),
    ],
)
def test_a_name_that_cannot_be_is_refused_with_its_package(entries, fault):
    with pytest.raises(BadInput, match=fault):
        catalogued(entries)


def test_a_module_that_is_gone_names_its_package():
    (app,) = catalogued([entry("mine", "there.is.no.such")])
    with pytest.raises(BadInput, match="reinstall theirs"):
        _ = app.interests


def test_a_module_without_declarations_is_named():
    (app,) = catalogued([entry("mine", "json")])
    with pytest.raises(BadInput, match="no INTERESTS"):
        _ = app.interests
