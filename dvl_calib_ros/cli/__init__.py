"""The command ``dvl-calib``, one module per command: parse arguments, make one library call, print and save."""
