"""A catalogue of many recordings. Callable: ``dvl_calib_ros.fleet(places, out)`` is `dvl_calib_ros.api.fleet`."""
