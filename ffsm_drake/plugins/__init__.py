"""Plug-ins: each folder is a package that can be deleted; nothing outside imports it by name.

The file ``plugin.py`` of each declares what it brings (``ffsm_drake.common.registrations``).
"""
