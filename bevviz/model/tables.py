"""Tables of results: pandas, polars and Arrow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from bevviz.errors import UserError

if TYPE_CHECKING:
    import pandas
    import pyarrow

Columns = Mapping[str, Any] | Sequence[Mapping[str, Any]]


class Tabular:
    """Results that can be read as a table, with a row for each of them."""

    __slots__ = ()

    def _columns(self) -> Columns:
        """Return the values of each column, or a mapping for each row."""
        raise NotImplementedError

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table of pandas.

        Raises:
            UserError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise UserError("a table needs pandas: pip install 'bevviz[notebook]'") from None
        return pandas.DataFrame(self._columns())

    def to_arrow(self) -> pyarrow.Table:
        """Return a table of Arrow, which other libraries read without a copy."""
        import pyarrow

        columns = self._columns()
        if isinstance(columns, Mapping):
            return pyarrow.table({name: pyarrow.array(list(values)) for name, values in columns.items()})
        return pyarrow.Table.from_pylist([*columns])

    def to_polars(self) -> Any:
        """Return a table of polars.

        Raises:
            UserError: polars is not installed.
        """
        try:
            import polars  # type: ignore[import-not-found, unused-ignore]
        except ImportError:
            raise UserError("this table needs polars: pip install polars") from None
        return polars.from_arrow(self.to_arrow())
