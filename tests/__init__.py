"""A package by name, since some libraries install a package `tests`, too."""
