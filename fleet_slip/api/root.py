"""What every part of a `Fleet` stands on: the data root and its tables."""

from fleet_slip.files.folder import Folder
from fleet_slip.warehouse.tables import Warehouse


class Rooted:
    """The warehouse of a data root. Making one touches nothing."""

    def __init__(self, warehouse: Warehouse) -> None:
        """Take the tables; `fleet_slip.open` makes them."""
        self.warehouse = warehouse

    @property
    def root(self) -> Folder:
        """The data root: a folder, or a place on an object store."""
        return self.warehouse.root

    def __repr__(self) -> str:
        """Return the class and the data root."""
        return f"{type(self).__name__}({str(self.root)!r})"
