"""What compares a published model with the paper and with filters. No night runs any of it.

`observers` estimate the side-slip angle in other ways, `evaluation` measures all of
them on test drives, `report` lays the paper's figures beside ours, and `watch` shows a drive.
"""
