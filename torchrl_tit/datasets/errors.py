"""The error for data that cannot be used."""


class DatasetError(ValueError):
    """A data set is damaged, incomplete, or of another task; the message names file, field and row.

    Args:
        source: The file, or another description of the source.
        problem: What is wrong, what was expected and what to do.
        field: Name of the field, if the problem is in one.
        row: Index of the row, if the problem is in one.

    Example:
        >>> print(DatasetError("a.hdf5", "is nan, but must be finite.", "rewards", 3))
        a.hdf5: field 'rewards', row 3: is nan, but must be finite.
    """

    def __init__(
        self, source: str, problem: str, field: str | None = None, row: int | None = None
    ) -> None:
        place = "" if field is None else f" field {field!r}"
        place += "" if row is None else f"{',' if place else ''} row {row}"
        super().__init__(f"{source}:{place}{':' if place else ''} {problem}")
