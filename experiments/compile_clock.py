"""How long JAX has compiled, to be taken off what a user waits for the first time only."""

import jax.monitoring

_EVENTS = ("/jax/core/compile/jaxpr_to_mlir_module_duration", "/jax/core/compile/backend_compile_duration")


class CompileClock:
    """Adds up lowering and compilation since it was made; tracing, whose parts are nested, is left out."""

    def __init__(self) -> None:
        self.seconds = 0.0
        jax.monitoring.register_event_duration_secs_listener(self._hear)

    def _hear(self, event: str, duration: float, **_: str | int) -> None:
        if event in _EVENTS:
            self.seconds += duration
