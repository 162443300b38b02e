"""Plug-ins: each folder is a package that can be deleted; nothing outside imports it by name.

A plug-in offers its objects by entry points of ``pyproject.toml``, as any installed package does.
``ffsm_drake.common.plugins`` lists the groups.
"""
