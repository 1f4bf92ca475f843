"""STEP files (ISO 10303-21, AP214) of curves in space, for CAD programs.

Each curve is one cubic B-spline through given points, interpolated with the not-a-knot condition
between its corners. The parameter is the abscissa X.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline

from ..files.output import replacing
from ..typing import PathLike

_DEGREE = 3

_PRODUCT = """\
#1=APPLICATION_CONTEXT('core data for automotive mechanical design processes');
#2=APPLICATION_PROTOCOL_DEFINITION('international standard','automotive_design',2000,#1);
#3=PRODUCT_CONTEXT('',#1,'mechanical');
#4=PRODUCT({name},{name},'',(#3));
#5=PRODUCT_RELATED_PRODUCT_CATEGORY('part',$,(#4));
#6=PRODUCT_DEFINITION_FORMATION('','',#4);
#7=PRODUCT_DEFINITION_CONTEXT('part definition',#1,'design');
#8=PRODUCT_DEFINITION('design','',#6,#7);
#9=PRODUCT_DEFINITION_SHAPE('','',#8);
#10=(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.));
#11=(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.));
#12=(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT());
#13=UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-06),#10,'distance_accuracy_value','');
#14=(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT((#13))\
GLOBAL_UNIT_ASSIGNED_CONTEXT((#10,#11,#12))REPRESENTATION_CONTEXT('',''));
#15=GEOMETRICALLY_BOUNDED_WIREFRAME_SHAPE_REPRESENTATION({name},(#17),#14);
#16=SHAPE_DEFINITION_REPRESENTATION(#9,#15);
#17=GEOMETRIC_CURVE_SET({name},({curves}));"""
_FIRST_FREE = 18


class Curve(NamedTuple):
    """A curve through points, smooth in each piece.

    **Fields:** `name`; `parameter`, rising, equal on both sides of a corner (points,); `points`
    (points, 3); `piece` of each point (points,).
    """

    name: str
    parameter: Float[np.ndarray, " points"]
    points: Float[np.ndarray, "points 3"]
    piece: np.ndarray


def write_step(path: PathLike, name: str, curves: Sequence[Curve]) -> None:
    """Writes curves in millimetres as one part with a name."""
    lines, places, number = [], [], _FIRST_FREE
    for curve in curves:
        entities = list(_entities(curve, number))
        lines += entities
        number += len(entities)
        places.append(f"#{number - 1}")
    product = _PRODUCT.format(name=_string(name), curves=",".join(places))
    header = (
        "ISO-10303-21;",
        "HEADER;",
        "FILE_DESCRIPTION(('curves'),'2;1');",
        f"FILE_NAME({_string(name)},'',(''),(''),'vsr_jax','','');",
        "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));",
        "ENDSEC;",
        "DATA;",
    )
    with replacing(path) as part:
        text = "\n".join((*header, product, *lines, "ENDSEC;", "END-ISO-10303-21;"))
        part.write_text(text + "\n", encoding="ascii")


def _entities(curve: Curve, number: int) -> Iterator[str]:
    """The points of a curve and, last, the curve, numbered from `number`."""
    knots, multiplicities, controls = _spline(curve)
    for i, point in enumerate(controls):
        yield f"#{number + i}=CARTESIAN_POINT('',{_reals(point)});"
    places = ",".join(f"#{number + i}" for i in range(len(controls)))
    counts = ",".join(str(count) for count in multiplicities)
    yield (
        f"#{number + len(controls)}=B_SPLINE_CURVE_WITH_KNOTS({_string(curve.name)},{_DEGREE},"
        f"({places}),.UNSPECIFIED.,.F.,.F.,({counts}),{_reals(knots)},.UNSPECIFIED.);"
    )


def _spline(curve: Curve) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Knots, their multiplicities and the control points of the spline; at a corner the
    multiplicity is the degree."""
    knots, controls = [], []
    for piece in np.unique(curve.piece):
        rows = curve.piece == piece
        spline = make_interp_spline(curve.parameter[rows], curve.points[rows], k=_DEGREE)
        first = not knots
        knots += [spline.t[: -_DEGREE - 1] if first else spline.t[_DEGREE + 1 : -_DEGREE - 1]]
        knots += [spline.t[-_DEGREE - 1 : -1]]
        controls += [spline.c if first else spline.c[1:]]
    knots.append(knots[-1][-1:])
    values, counts = np.unique(np.concatenate(knots), return_counts=True)
    return values, counts, np.concatenate(controls)


def _string(text: str) -> str:
    r"""A string of the exchange format: quotes doubled, characters beyond ASCII as \X2\....\X0\."""
    doubled = text.replace("\\", "\\\\").replace("'", "''")
    return "'" + "".join(map(_character, doubled)) + "'"


def _character(letter: str) -> str:
    if " " <= letter <= "~":
        return letter
    return (
        f"\\X2\\{letter.encode('utf-16-be').hex().upper()}\\X0\\" if letter.isprintable() else " "
    )


def _reals(values: np.ndarray) -> str:
    return "(" + ",".join(f"{value + 0.0:.12E}" for value in values) + ")"
