"""The command ``dvl-calib``: one module per command, arguments -> one library call -> print and save."""
