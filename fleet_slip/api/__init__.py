"""The Python API, on which the command line is written; `fleet_slip.open` is the way in."""
