"""fTetWild in a process of its own: `python ftetwild_process.py surface.npz tets.npz`.

fTetWild can abort the whole process (seen at large tolerances), which no `except` catches. This
file is run by its path, so that neither JAX nor this package is imported.
"""

import sys

import numpy as np
import pytetwild


def main(surface: str, result: str) -> None:
    """Read vertices, faces, edge and epsilon from one .npz; write vertices and tets to another."""
    with np.load(surface) as given:
        vertices, tets = pytetwild.tetrahedralize(
            given["vertices"],
            given["faces"],
            edge_length_fac=float(given["edge"]),
            epsilon=float(given["epsilon"]),
            coarsen=True,
            num_threads=1,
            quiet=True,
        )
    np.savez(result, vertices=np.asarray(vertices, np.float64), tets=np.asarray(tets, np.int32))


if __name__ == "__main__":
    main(*sys.argv[1:])
