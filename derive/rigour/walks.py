"""Walks over expressions that meet every different part once, where SymPy's own meet each copy."""

from collections.abc import Mapping

import sympy as sp


def once(*expressions: sp.Basic) -> list[sp.Basic]:
    """List every different part, parts before what they are in."""
    done: dict[sp.Basic, None] = {}
    stack: list[tuple[sp.Basic, bool]] = [(expression, False) for expression in expressions]
    while stack:
        node, ready = stack.pop()
        if ready:
            done[node] = None
        elif node not in done:
            stack.append((node, True))
            stack.extend((part, False) for part in node.args if part not in done)
    return list(done)


def replaced(expression: sp.Basic, new: Mapping[sp.Basic, sp.Basic]) -> sp.Basic:
    """Put other expressions in place of parts; cases that are ruled out are left away unseen."""
    done = dict(new)
    stack = [expression]
    while stack:
        node = stack[-1]
        missing = [] if node in done else [part for part in _needed(node, done) if part not in done]
        if missing:
            stack.extend(missing)
            continue
        stack.pop()
        if node not in done:
            done[node] = _rebuilt(node, done)
    return done[expression]


def _needed(node: sp.Basic, done: Mapping[sp.Basic, sp.Basic]) -> list[sp.Basic]:
    """List the parts whose new form a node waits for: of a case, first its condition."""
    if not isinstance(node, sp.Piecewise):
        return list(node.args)
    conditions = [condition for _, condition in node.args]
    if any(condition not in done for condition in conditions):
        return conditions
    return [value for value, condition in node.args if done[condition] != sp.false]


def _rebuilt(node: sp.Basic, done: Mapping[sp.Basic, sp.Basic]) -> sp.Basic:
    if isinstance(node, sp.Piecewise):
        cases = [(value, done[condition]) for value, condition in node.args]
        cases = [(done[value], condition) for value, condition in cases if condition != sp.false]
        return node if tuple(cases) == tuple(map(tuple, node.args)) else node.func(*cases)
    parts = [done[part] for part in node.args]
    # a part that is not new is the same object: nothing has to be compared
    same = all(new is old for new, old in zip(parts, node.args, strict=True))
    return node if same else node.func(*parts)
