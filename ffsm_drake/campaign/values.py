"""Scenario values in plain data by dotted key, such as ``payload.truth.center_of_mass.0``."""

from typing import Any

from ffsm_drake.campaign.errors import CampaignError


def get_value(data: Any, key: str) -> Any:
    """The value at a dotted key; numbers address list entries. Raises CampaignError where there is none."""
    for part in key.split("."):
        if isinstance(data, list) and part.isdecimal() and int(part) < len(data):
            data = data[int(part)]
        elif isinstance(data, dict) and part in data:
            data = data[part]
        else:
            raise CampaignError(f"{key}: the scenario has no such value")
    return data


def set_value(data: Any, key: str, value: Any) -> None:
    """Write the value at a dotted key; missing mappings are added; the scenario's schema checks them later.

    Raises:
      CampaignError: the key leads through a single value, or past the end of a list.
    """
    *parents, last = key.split(".")
    for part in parents:
        if isinstance(data, list):
            data = data[_index(data, part, key)]
        elif isinstance(data, dict):
            if data.get(part) is None:
                data[part] = {}
            data = data[part]
        else:
            raise CampaignError(f"{key}: unknown key; '{part}' lies within a single value")
    if isinstance(data, list):
        data[_index(data, last, key)] = value
    elif isinstance(data, dict):
        data[last] = value
    else:
        raise CampaignError(f"{key}: unknown key; '{last}' lies within a single value")


def _index(data: list[Any], part: str, key: str) -> int:
    if not part.isdecimal() or int(part) >= len(data):
        raise CampaignError(f"{key}: '{part}' must be a number from 0 to {len(data) - 1}")
    return int(part)
