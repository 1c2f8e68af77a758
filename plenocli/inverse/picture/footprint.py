"""How much memory reconstruct and learn-dict take, counted from the sizes of their arrays before
they start (docs/model.md, "Faults, memory and repetition"). What numbers stand for: arrays of eight
bytes a number that are held at the same time, measured where a library makes them.
"""

import numpy as np

from plenocli.base.budget import budget

NUMBER = 8


def reconstruction(system, lenslets, method, directions, *, joint=False, atoms=0):
    """Bytes for `lenslets` (count) behind a stages.systems.System.

    directions: singular vectors through which the joint estimate sees a superpixel.
    joint: whether that estimate is made;
    atoms: of the dictionary.
    """
    blocks, (pixels, points) = system.blocks.size, system.own.shape
    least, block, wide = (
        min(pixels, points),
        points // max(1, len(system.bands)),
        2 * int(np.abs(system.offsets).max(initial=0)) + 1,
    )
    svd, y = least * (pixels + points), lenslets * pixels
    phases = [
        1.5 * blocks,
        lenslets * (3.25 * pixels + 1.5 * points),
        y + 4.3 * pixels * points + least**2,
    ]
    if joint or method in ("lmmse", "auto", "tv", "pnp"):
        phases += [
            y + svd + 13 * block**2,
            svd + block**2 + lenslets * (2 * pixels + 4 * points + 240),
        ]
    if joint:
        footprints = (2 * wide**2 + (wide + 4) ** 2 + len(system.blocks) + 18) * directions * points
        phases += [
            y + svd + block**2 + footprints + 268 * directions**2,
            svd
            + block**2
            + 18 * directions * points
            + 243 * directions**2
            + lenslets * (2 * pixels + 4 * points + 240 + 20 * directions),
        ]
    if method == "nnls":
        phases.append(y + svd + 2 * least * points + points**2 + lenslets * points)
    if atoms:
        phases.append(
            y + svd + 3 * points * atoms + atoms**2 + 3 * least * atoms + lenslets * points
        )
    if method in ("tv", "auto", "pnp"):
        phases.append(svd + block**2 + lenslets * points * (20 if method == "tv" else 137))
    return NUMBER * (blocks + max(phases))


def require_reconstruction(camera, data, where):
    """NumericsError, before anything is worked out, where the Superpixels `data` do not fit the
    memory of this process.
    """
    from plenocli.inverse.picture.solvers.joint_lmmse import MOST

    settings, system = camera.settings, camera.system
    sizes = dict(
        joint=camera.overlap == 3
        and (camera.coupled or settings.method == "lmmse")
        and settings.method != "block-mean",
        atoms=camera.learnt.atoms.shape[1] if settings.dictionary is not None else 0,
    )
    lenslets, most = data.y.shape[0] * data.y.shape[1], min(MOST, *system.own.shape)
    needed = reconstruction(system, lenslets, settings.method, most, **sizes)
    # what stands above the noise decides, and may be much less
    if needed > budget().memory > 3 * NUMBER * system.own.size:
        needed = reconstruction(
            system,
            lenslets,
            settings.method,
            min(most, _directions(system.own, settings.noise_sigma or data.sigma or 0.0)),
            **sizes,
        )
    budget().require(
        needed,
        "the reconstruction",
        where,
        "take fewer lenslets or points, or another --method",
    )


def _directions(own, sigma):
    """Singular vectors of `own` (pixel, point) whose signal can exceed a hundredth of the noise,
    about: of photographs of a standard deviation of 0.25.
    """
    strength = 0.25 * np.linalg.svd(own, compute_uv=False) * np.sqrt(own.shape[1])
    return max(1, int(np.count_nonzero(strength > 0.01 * sigma)))


def learning(shape, offsets, atoms, batch, synthesis):
    """Bytes of learn-dict for a matrix of `shape` (pixel, point), its neighbours' blocks in hand.

    What a batch is coded and refitted with goes back to the system in part only, before the
    training patches of the LMMSE beside which the dictionary is judged are drawn.
    """
    pixels, points = shape
    held = offsets * pixels * points + min(shape) * (pixels + points)
    step = (
        3.3 * batch * atoms
        + 0.5 * batch * points
        + 4 * atoms**2
        + 3.4 * points * atoms
        + (3 * atoms**2 + 2 * points * atoms if synthesis else 0)
    )
    judged = 12 * points**2
    return NUMBER * (
        held + max(4.3 * pixels * points + min(shape) ** 2, step, judged + min(step, judged))
    )


def require_learning(system, chosen, settings, where):
    """NumericsError, before the decomposition, where learn-dict with solvers.dictionary.Settings
    `chosen` does not fit the memory of this process.
    """
    needed = learning(
        system.own.shape, len(system.blocks), chosen.atoms, chosen.batch, settings.synthesis
    )
    budget().require(
        needed,
        "learning",
        where,
        "take a smaller --batch, fewer --atoms or points",
    )
