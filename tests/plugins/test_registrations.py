"""What each plug-in of this package declares."""

import pytest

from ffsm_drake.common.registrations import Registry, own_plugins


@pytest.mark.parametrize("plugin", own_plugins())
@pytest.mark.smoke
def test_what_it_brings_is_its_own_and_loads(plugin):
    for group, names in own_plugins()[plugin].brings.items():
        for name, address in names.items():
            assert address.partition(":")[0].partition(".")[0] == plugin
            assert Registry(group).load(name, "here") is not None
