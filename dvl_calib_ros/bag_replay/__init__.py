"""The calibration over recorded bags. Callable: ``dvl_calib_ros.replay(bag)`` is `dvl_calib_ros.api.replay`."""
