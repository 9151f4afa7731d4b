"""See `rclpy`."""


class Image:
    name = "sensor_msgs/msg/Image"


class CompressedImage:
    name = "sensor_msgs/msg/CompressedImage"


class PointCloud2:
    name = "sensor_msgs/msg/PointCloud2"
