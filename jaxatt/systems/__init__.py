"""Published closed loops, one module each: ``system``, ``params`` and ``scenario`` are the paper's."""
