"""What is read of a plant: its split and what bounds g, structural conditions first."""

from dataclasses import dataclass

import numpy as np

from obsynth.derive import JacobianBounds, Majorant, Split, jacobian_bounds, majorant, split
from obsynth.derive.errors import DerivationError, StructureError
from obsynth.derive.structure.conditions import scaled_rank
from obsynth.designs.core.given import PlantClass
from obsynth.designs.hinf.record import Bound, HinfDesign
from obsynth.designs.hinf.system import ROOM, Filter, SectorForm, build_sector
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

CLASS = PlantClass(
    who="the H-infinity unknown input observer",
    time="discrete",
    forbids={
        "p": ": this method has none; give it a value, or declare its effect as a disturbance",
        "rho": ": this method has none; declare it as an input, whose range bounds it",
    },
    needs={
        "f": "there is no fault to estimate: declare actuator_faults or faults",
        "w": "so there is nothing to attenuate: declare disturbances and put them into the "
        "dynamics",
    },
)
RANK = 1e-9


@dataclass(frozen=True, eq=False)
class Derived:
    """What follows from the equations: split, bounds of its g, majorant where asked for."""

    split: Split
    bounds: JacobianBounds
    majorant: Majorant | None


@dataclass(frozen=True, eq=False)
class HinfModel(Derived):
    """A plant of the class; its design is complete except for gains and bound, which are zero."""

    design: HinfDesign


def read(
    given: Plant | Split, form: SectorForm | None = None, bounds: JacobianBounds | None = None
) -> HinfModel:
    """Split, check the structural conditions, bound the nonlinearity."""
    if isinstance(given, Plant):
        point = (np.zeros(len(given.x)), np.zeros(len(given.u)))
        parts = split(given, at=point, linear="terms")
    else:
        parts = given
    model = parts.model
    L = check_decoupling(parts)
    if bounds is None:
        bounds = jacobian_bounds(parts)
    n, m, n_f = len(model.x), len(parts.C), len(model.f)
    found = sector = None
    if form is not None:
        found = derive_majorant(parts, form)
        sector = build_sector(found, form)
    design = HinfDesign(
        plant=model,
        linear=parts.linear,
        x_at=np.asarray(parts.at.x, dtype=float),
        u_at=np.asarray(parts.at.u, dtype=float),
        A=parts.A,
        B=parts.B,
        C=parts.C,
        L=L,
        W=parts.W1,
        A_radius=np.zeros((n, n)) if found is None or sector is None else found.rounding,
        W_radius=parts.proof.rounding["W1"],
        family=bounds.family,
        sector_form=form,
        sector=sector,
        gains=Filter(np.zeros((n, m)), np.zeros((n, m)), np.zeros((n_f, m)), np.zeros((n_f, m))),
        bound=Bound(1.0, np.zeros((n, n)), np.zeros(0), np.zeros(0)),
        options={},
    )
    check_detectability(parts, design.data.G, design.data.vertices)
    return HinfModel(parts, bounds, found, design)


def read_again(design: HinfDesign) -> Derived:
    """Derive split, Jacobian bounds and majorant from the stored equations."""
    parts = split(design.plant, at=(design.x_at, design.u_at), linear=design.linear)
    form = None if design.sector is None else design.sector_form
    found = None if form is None else derive_majorant(parts, form)
    return Derived(parts, jacobian_bounds(parts), found)


def derive_majorant(parts: Split, form: SectorForm) -> Majorant:
    """Derive M'M, or prove that a given diagonal is one."""
    free, given = majorant(parts), form.given
    if given is None:
        return free
    names = parts.model.names("x")
    if len(given) != len(names):
        raise DerivationError(
            f"majorant= has {len(given)} numbers; M'M has {len(names)} on its diagonal "
            f"({', '.join(names)})"
        )
    needed = [bool(column.any()) for column in free.entry_bounds.T]
    for name, value, used in zip(names, given, needed, strict=True):
        if used and not value > 0.0:
            raise DerivationError(
                f"majorant= has {value} for {name}, on which g depends: it has to be positive",
                symbol=name,
            )
    fixed = {n: v * ROOM for n, v, used in zip(names, given, needed, strict=True) if used}
    return majorant(parts, fixed=fixed) if fixed else free


def check_decoupling(parts: Split) -> FloatArray:
    """Check rank(C L) = rank(L) = s of (15) and return L, faults first, then unknown inputs."""
    _refuse_noisy_outputs(parts)
    model = parts.model
    names = (*model.names("f"), *model.names("d"))
    L = np.hstack([parts.B_f, parts.D])
    s = L.shape[1]
    dead = [name for name, column in zip(names, L.T, strict=True) if not column.any()]
    if dead:
        raise StructureError(
            f"{', '.join(dead)} enters no equation; remove it", symbols=tuple(dead), rank_L=s
        )
    CL = parts.C @ L
    ranks = [scaled_rank(L), scaled_rank(CL)]
    if ranks[1] < s:
        _, values, vectors = np.linalg.svd(_normalised(CL), full_matrices=True)
        full = np.zeros(s)
        full[: len(values)] = values
        lost = vectors[full <= RANK * max(1.0, full.max())]
        blamed = tuple(n for j, n in enumerate(names) if np.abs(lost[:, j]).max() > 1e-6)
        acts = [x for i, x in enumerate(model.names("x")) if np.abs(L[i] @ lost.T).max() > 1e-9]
        where = f" acts on {', '.join(acts)}, but" if acts else ""
        raise StructureError(
            f"rank(C L) = {ranks[1]} and rank(L) = {ranks[0]} for {s} faults and unknown inputs: "
            f"{', '.join(blamed)}{where} cannot be told from the outputs "
            f"({', '.join(model.output_names)}) one sample later, which (15) needs. Measure "
            f"{acts[0] if acts else 'another state'} as well, or merge what acts alike",
            symbols=blamed,
            states=tuple(acts),
            rank_L=ranks[0],
            rank_CL=ranks[1],
            required=s,
        )
    return L


def _refuse_noisy_outputs(parts: Split) -> None:
    """Refuse disturbances in the outputs: (22) has none."""
    rows, columns = np.nonzero(parts.W2)
    if rows.size:
        w = parts.model.names("w")[columns[0]]
        y = parts.model.output_names[rows[0]]
        raise StructureError(
            f"the disturbance {w} enters the output {y}, and equation (2) has none: make it a "
            f"state of its own, n_next = {w}, and write n in place of {w} in all equations and "
            "outputs, which delays it by one sample and changes no energy",
            symbol=w,
            row=y,
        )


def _normalised(matrix: FloatArray) -> FloatArray:
    size = np.linalg.norm(matrix, axis=0)
    return np.asarray(matrix / np.where(size > 0.0, size, 1.0))


def check_detectability(parts: Split, G: FloatArray, vertices: FloatArray) -> None:
    """Test (G (A + M), C) at every vertex: the zeros of (A + M, L, C) have to be stable."""
    n = len(parts.A)
    names = parts.model.names("x")
    for index, M in enumerate(vertices):
        matrix = G @ (parts.A + M)
        for mode in np.linalg.eigvals(matrix):
            if abs(mode) < 1.0 - RANK:
                continue
            pencil = np.vstack([mode * np.eye(n) - matrix, parts.C.astype(complex)])
            # Columns are measured before they cancel, so that what rounding leaves stays small.
            terms = np.vstack([abs(mode) * np.eye(n) + np.abs(matrix), np.abs(parts.C)])
            size = np.linalg.norm(terms, axis=0)
            _, values, vectors = np.linalg.svd(pencil / size)
            if values[-1] > RANK:
                continue
            motion = np.abs(vectors[-1]) / size
            moving = [x for x, size in zip(names, motion, strict=True) if size > 1e-6 * max(motion)]
            raise StructureError(
                f"the states {', '.join(moving)} have a motion with the mode {mode:.6g}, which "
                "does not decay, that a fault hides from the outputs (a zero of (A + M, L, C) at "
                f"vertex {index + 1} of the Jacobian family): no gain makes the error decay. "
                f"Measure {moving[0]} as well",
                condition="detectability",
                symbols=tuple(moving),
                mode=complex(mode),
                vertex=M,
                vertex_index=index,
            )
