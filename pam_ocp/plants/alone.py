"""A muscle alone, with its feed and losses: length and speed in, force out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca

from ..core.stop import verb
from ..core.system import Scope
from ..muscles.pneumatic_muscle import Muscle
from .components import as_muscle
from .damping import Loss
from .feeds import AttachedMuscle, Feed, IdealPressure
from .plant import Plant


@verb
def muscle_alone(
    muscle: Muscle | str,
    *,
    feed: Feed | None = None,
    losses: Loss | Sequence[Loss] = (),
    name: str = "muscle",
) -> Plant:
    """A plant of one muscle that something else moves: for multibody tools, which have the masses.

    Inputs are ``<name>.length`` (between its ends [m]; the rest length at contraction 0),
    ``<name>.speed`` (that at which it grows longer [m/s]) and the commands of its feed; the output
    ``<name>.force`` pulls the ends together [N]. States are those of the feed and of the losses;
    an ``IdealPressure`` counts its work.

    Raises InputError as ``Plant.add_muscle``.

    Examples
    --------
    >>> alone = pam.plants.muscle_alone(muscle, feed=pam.feeds.Regulator(0.05))
    >>> [v.name for v in alone.inputs]
    ['muscle.length', 'muscle.speed', 'muscle.command']
    """
    return attached_alone(muscle, feed, losses, name)[0]


def attached_alone(
    muscle: Muscle | str, feed: Feed | None, losses: Loss | Sequence[Loss], name: str
) -> tuple[Plant, AttachedMuscle]:
    """The same plant, still open, and the expressions of its muscle."""
    muscle = as_muscle(muscle)
    if isinstance(feed, IdealPressure):
        feed = replace(feed, totals=True)  # a plant without a state is none
    rest, reach = float(muscle.rest_length), float(muscle.contraction_range[1])
    plant = Plant(name, f"{muscle.name or 'a muscle'} alone, moved from outside")
    scope = Scope(plant, name)
    length = scope.of("m", reach * rest, start=rest, min=0.0, max=2 * rest, disturbance=True).input(
        "length", f"length of {name} between its ends"
    )
    speed = scope.of("m/s", reach * rest, disturbance=True).input(
        "speed", f"speed at which {name} grows longer"
    )
    # contraction 1 - length/rest_length, with the parameter that the muscle brings along
    attached = plant.add_muscle(
        name,
        muscle,
        shortening=-length,
        rate=-speed,
        pre_contraction=ca.SX(1),
        feed=feed,
        losses=losses,
    )
    return plant, attached
