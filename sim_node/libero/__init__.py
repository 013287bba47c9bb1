"""LIBERO as an environment: quiet import, a lean control loop, start states."""
