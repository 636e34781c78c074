"""What hangs together, directly or through others."""

from collections.abc import Collection, Hashable, Iterable


def connected(keys: Iterable[Collection[Hashable]]) -> list[list[int]]:
    """Group positions that have keys in common; ascending, each group at its last position."""
    groups: list[tuple[list[int], set[Hashable]]] = []
    for k, own in enumerate(keys):
        members, known = [k], set(own)
        apart = []
        for group in groups:
            if group[1] & known:
                members, known = group[0] + members, group[1] | known
            else:
                apart.append(group)
        groups = [*apart, (members, known)]
    return [sorted(members) for members, _ in groups]
