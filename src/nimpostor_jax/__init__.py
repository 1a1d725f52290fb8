"""Neural Impostor in JAX: editable radiance fields on tetrahedral cages."""
