"""The slow obvious matcher: patterns become regular expressions, specs are compared one by one."""

import itertools
import re


def matches_path(pattern: str, path: str) -> bool:
    """Whether a path without wildcards matches a pattern."""
    text = re.escape(pattern).replace(r"\*\*", "@@").replace(r"\*", "[A-Za-z0-9_-]+")
    text = text.replace(r"\.@@", r"(\.[A-Za-z0-9_-]+)*").replace("@@", ".*")
    return re.fullmatch(text, path) is not None


def matches(pattern: str, item: str) -> bool:
    """Whether an observer of `pattern` receives an item written under `item`."""
    p_path, _, p_specs = pattern.partition(":")
    i_path, _, i_specs = item.partition(":")
    there = dict(s.split("=") for s in i_specs.split(",") if s)
    for spec in (s for s in p_specs.split(",") if s):
        name, value = spec.split("=")
        if name not in there or (value != "*" and there[name] not in value.split("|")):
            return False
    return matches_path(p_path, i_path)


def overlap(left: str, right: str, alphabet: str = "ab", longest: int = 4) -> bool:
    """Whether some path of at most `longest` segments matches both patterns, by trying all of them."""
    for length in range(1, longest + 1):
        for segments in itertools.product(alphabet, repeat=length):
            path = ".".join(segments)
            if matches_path(left, path) and matches_path(right, path):
                return True
    return False
