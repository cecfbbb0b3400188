# messages, services, dynamic_reconfigure, catkin_package
