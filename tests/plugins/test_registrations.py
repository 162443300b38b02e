"""What each plug-in of this package declares, and what the registries of the rooms say of it."""

import ast
import collections.abc
import importlib
import inspect
import typing
from pathlib import Path

import pytest

import ffsm_drake
from ffsm_drake.common.registrations import Registry, offered, own_plugins, plugin_of

PACKAGE = Path(ffsm_drake.__file__).parent
BROUGHT = [
    (name, group, offer)
    for name, plugin in own_plugins().items()
    for group, offers in plugin.brings.items()
    for offer in offers
]


def registries() -> dict[tuple[str, str], list[Registry]]:
    """The registries by module and name there; a dictionary can have several."""
    found = {}
    for file in PACKAGE.rglob("*.py"):
        if "Registry[" in file.read_text():
            module = ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts)
            module = module.removesuffix(".__init__")
            for name, value in vars(importlib.import_module(module)).items():
                values = value.values() if isinstance(value, dict) else [value]
                found[module, name] = [each for each in values if isinstance(each, Registry)]
    return found


REGISTRIES = registries()
KINDS = {
    registry.group: typing.get_args(registry.__orig_class__)[0]
    for found in REGISTRIES.values()
    for registry in found
}


@pytest.mark.parametrize(("plugin", "group", "name"), BROUGHT)
@pytest.mark.smoke
def test_what_it_brings_is_its_own_and_as_the_registry_says(plugin, group, name):
    offer = offered(group)[name]
    assert plugin_of(offer.module) == plugin
    check(offer.load(), KINDS[group])


def check(found: object, kind: typing.Any) -> None:
    """Fail unless an object is of a kind: a class, or a function with a signature."""
    origin = typing.get_origin(kind)
    if kind is type:
        assert isinstance(found, type)
    elif origin is type:
        assert issubclass(found, typing.get_args(kind))
    elif origin is collections.abc.Callable:
        if (arguments := typing.get_args(kind)[0]) is not ...:
            inspect.signature(getattr(found, "from_setup", found)).bind(*arguments)
    elif "__call__" in vars(kind):
        _, *wanted = inspect.signature(kind.__call__).parameters.values()
        by_name = {each.name: each for each in wanted if each.kind is each.KEYWORD_ONLY}
        by_place = [each for each in wanted if each.kind is each.POSITIONAL_OR_KEYWORD]
        inspect.signature(found).bind(*by_place, **by_name)
    else:
        assert kind in type(found).__mro__  # so mypy compares the methods


def reached_by(plugin: str) -> set[str]:
    """The plug-ins that bring into the registries that a plug-in has or imports."""
    named = {key for key in REGISTRIES if plugin_of(key[0]) == plugin}
    for file in (PACKAGE / "plugins" / plugin).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom):
                named |= {(node.module, name.name) for name in node.names}
    offers = [
        offer
        for key in named & REGISTRIES.keys()
        for registry in REGISTRIES[key]
        for offer in registry.offers().values()
    ]
    return {plugin_of(offer.module) for offer in offers} - {""}  # the core


@pytest.mark.parametrize("plugin", own_plugins())
def test_it_uses_those_that_bring_into_its_registries(plugin):
    own = own_plugins()[plugin]
    assert sorted(reached_by(plugin) - {plugin, *own.needs}) == list(own.uses)
