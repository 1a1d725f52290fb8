"""Fig. 14 of the paper: a snowman, put together from parts that come with the project.

    python experiments/snowman.py --out=out/snowman

Trains the built-in furry ball (or takes --ball, the workdir of such a run) and gives its fur the colours of
snow and of wood: three balls, arms (stretched balls), a hat, a nose and eyes, composed into one impostor.
Writes impostor.npz, frame.png and orbit.gif.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from edit_compose import around
from edit_deform import load_run

from nimpostor_jax.edit.appearance import uniform, with_material
from nimpostor_jax.edit.boolean import gated
from nimpostor_jax.edit.compose import compose
from nimpostor_jax.export.video import write_video
from nimpostor_jax.geometry.topology import build_tet_mesh, world_vertices
from nimpostor_jax.gin_flags import add_flags, config_from_args, config_of_runs, run_cli, save_config
from nimpostor_jax.io.images import write_png
from nimpostor_jax.io.impostor_file import save_impostor
from nimpostor_jax.pipeline.fit import fit
from nimpostor_jax.pipeline.prepare import prepare, use_all_cores
from nimpostor_jax.preprocess.patterns import solid_from_surface
from nimpostor_jax.preprocess.tetrahedralize import box_tets
from nimpostor_jax.render.frame import frame_config, render_frame, to_image
from nimpostor_jax.types import NeuralImpostor

DENSITY = 300.0  # of hard parts: opaque within a hundredth of their box
SNOW, WOOD = (0.93, 0.95, 0.99), (0.45, 0.28, 0.12)
HAT, CARROT, COAL = (0.08, 0.08, 0.1), (0.95, 0.45, 0.08), (0.03, 0.03, 0.03)
MATERIAL = 0.8  # share of a material's colour; the rest is the fur's own light and shade


def main(argv: Sequence[str]) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--ball", type=Path, help="workdir of a run on fluffy_ball; default: train one")
    parser.add_argument("--size", type=int, default=300, help="image width and height")
    parser.add_argument("--frames", type=int, default=24, help="of the animation; 0: none")
    add_flags(parser)
    args = parser.parse_args(argv)
    use_all_cores()
    if args.size < 8:
        raise ValueError(f"--size must be >= 8, got {args.size}")
    config = config_from_args(args) if args.ball is None else config_of_runs([args.ball], args)
    if args.ball is not None:
        ball = load_run(args.ball, "fluffy_ball")
    else:
        ball, _ = fit(prepare(config, "fluffy_ball"))
    snowman = build(ball)
    save_impostor(args.out / "impostor.npz", snowman)
    save_config(config, args.out)  # with which other scripts render it
    cameras = around(snowman, args.size, max(args.frames, 1))
    sized = frame_config(snowman, cameras[0], config.render)
    frames = [to_image(render_frame(snowman, camera, sized)) for camera in cameras]
    write_png(args.out / "frame.png", frames[0])
    if args.frames:
        write_video(args.out / "orbit.gif", frames, 12.0)
    count = int(snowman.mesh.object_ids.max()) + 1
    print(f"{len(snowman.mesh.tets)} tets in {count} objects; wrote {args.out}")


def build(ball: NeuralImpostor) -> NeuralImpostor:
    """The snowman: z is up, it looks along -y, and is about five units tall."""
    snow, wood = (colored(ball, color) for color in (SNOW, WOOD))
    body = [placed(snow, size, (0, 0, z)) for size, z in ((1.3, 1.2), (1.0, 2.9), (0.7, 4.2))]
    arms = [
        placed(wood, (0.9, 0.1, 0.1), (side * 1.5, 0, 3.2), turn=-side * 0.5) for side in (-1.0, 1.0)
    ]
    hat = trimesh.util.concatenate(
        [
            trimesh.creation.cylinder(0.75, 0.1, transform=shift(0, 0, 4.75)),
            trimesh.creation.cylinder(0.45, 0.7, transform=shift(0, 0, 5.1)),
        ]
    )
    nose = trimesh.creation.cone(0.11, 0.6)
    nose.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    nose.apply_translation([0, -0.62, 4.2])
    eyes = [trimesh.creation.icosphere(3, 0.09).apply_translation([x, -0.64, 4.42]) for x in (-0.22, 0.22)]
    hard = [(hat, HAT), (nose, CARROT), *((eye, COAL) for eye in eyes)]
    return compose([*body, *arms, *(hard_part(surface, color, ball) for surface, color in hard)])


def colored(ball: NeuralImpostor, color: tuple[float, ...]) -> NeuralImpostor:
    """The ball with most of its colour replaced."""
    vertices = world_vertices(ball.mesh)
    around = trimesh.creation.box(bounds=[vertices.min(axis=0) - 1, vertices.max(axis=0) + 1])
    material = uniform(ball.mesh, color, DENSITY, ball.config)
    return with_material(ball, solid_from_surface(around, 16), material, MATERIAL)


def shift(x: float, y: float, z: float) -> np.ndarray:
    """A translation."""
    return trimesh.transformations.translation_matrix([x, y, z])


def placed(
    impostor: NeuralImpostor, size: float | tuple[float, ...], place: Sequence[float], turn: float = 0.0
) -> NeuralImpostor:
    """An impostor with its cage's middle at a place, of half a size, turned about the y axis."""
    vertices = world_vertices(impostor.mesh)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    half = (vertices.max(axis=0) - vertices.min(axis=0)).max() / 2
    scale = np.diag([*(np.broadcast_to(size, 3) / half), 1.0])
    rotation = trimesh.transformations.rotation_matrix(turn, [0, 1, 0])
    return compose([impostor], [shift(*place) @ rotation @ scale @ shift(*-middle)])


def hard_part(
    surface: trimesh.Trimesh, color: tuple[float, ...], like: NeuralImpostor
) -> NeuralImpostor:
    """A closed surface filled with one colour."""
    margin = 0.02 * float(np.linalg.norm(surface.extents))
    mesh = build_tet_mesh(*box_tets(surface.bounds + np.array([[-margin], [margin]])))
    solid = solid_from_surface(surface, 96, allow_self_intersections=True)
    return gated(uniform(mesh, color, DENSITY, like.config), solid, keep_inside=True)


if __name__ == "__main__":
    run_cli(main)
