"""Error against run time, robustness and rivals: what `jaxsand bench` runs."""
