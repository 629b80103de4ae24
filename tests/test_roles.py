"""Topics and the roles that they are given."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bevviz.config import SourceConfig
from bevviz.errors import UserError
from bevviz.messages.roles import Roles, find_roles
from bevviz.messages.topics import RESERVED, Topic, entity_name
from bevviz.recording import entities

CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGE = "sensor_msgs/msg/Image"
JPEG = "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
BOXES_2D = "vision_msgs/msg/Detection2DArray"
BOXES_3D = "vision_msgs/msg/Detection3DArray"
TF = "tf2_msgs/msg/TFMessage"
ODOMETRY = "nav_msgs/msg/Odometry"

LEFT, RIGHT = "zed2_left_camera_optical_frame", "zed2_right_camera_optical_frame"
TUTORIAL = [
    Topic("/detection/camera_2d", BOXES_2D, 10, LEFT),
    Topic("/detection/camera_annotated", IMAGE, 10, LEFT),
    Topic("/detection/fused_3d", BOXES_3D, 10, "rslidar"),
    Topic("/detection/lidar_clusters", BOXES_3D, 10, "rslidar"),
    Topic("/lidar/points_no_ground", CLOUD, 10, "rslidar"),
    Topic("/rosout", "rcl_interfaces/msg/Log", 3),
    Topic("/rslidar_points", CLOUD, 10, "rslidar"),
    Topic("/tf", TF, 100),
    Topic("/tf_static", TF, 1),
    Topic("/visualization/bev_image", IMAGE, 10, "rslidar"),
    Topic("/zed2/zed/depth/camera_info", INFO, 10, LEFT),
    Topic("/zed2/zed/depth/depth_registered", IMAGE, 10, LEFT),
    Topic("/zed2/zed/odom", ODOMETRY, 10, "odom"),
    Topic("/zed2/zed/point_cloud/cloud_registered", CLOUD, 10, LEFT),
    Topic("/zed2/zed/rgb/camera_info", INFO, 10, LEFT),
    Topic("/zed2/zed/rgb/image_rect_color", IMAGE, 10, LEFT),
    Topic("/zed2/zed/rgb/image_rect_color/compressed", JPEG, 10, LEFT),
    Topic("/zed2/zed/rgb_raw/camera_info", INFO, 10, LEFT),
    Topic("/zed2/zed/rgb_raw/image_raw_color", IMAGE, 10, LEFT),
]
STEREO = [
    Topic("/zed2/zed/left/camera_info", INFO, 10, LEFT),
    Topic("/zed2/zed/left/image_rect_color", IMAGE, 10, LEFT),
    Topic("/zed2/zed/right/camera_info", INFO, 10, RIGHT),
    Topic("/zed2/zed/right/image_rect_color", IMAGE, 10, RIGHT),
    Topic("/zed2/zed/right_raw/image_raw_color", IMAGE, 10, RIGHT),
    Topic("/zed2/zed/stereo/image_rect_color", IMAGE, 10, LEFT),
]
DEFAULT = SourceConfig()


def cameras(roles: Roles) -> dict[str, str]:
    return {camera.name: camera.topic for camera in roles.cameras}


def test_roles_of_the_tutorial_robot_are_recognized() -> None:
    roles = find_roles(TUTORIAL, DEFAULT)
    assert roles.lidars == ("/rslidar_points",) and roles.lidar_names == ("rslidar",)
    (camera,) = roles.cameras
    assert (camera.name, camera.topic) == ("zed", "/zed2/zed/rgb/image_rect_color")
    assert camera.info_topic == "/zed2/zed/rgb/camera_info" and camera.rectified and camera.kind == "Image"
    assert roles.tf == ("/tf",) and roles.tf_static == ("/tf_static",) and roles.odometry == "/zed2/zed/odom"
    assert roles.robot_detections_2d == ("/detection/camera_2d",)
    assert roles.robot_detections_3d == ("/detection/fused_3d", "/detection/lidar_clusters")
    assert roles.truth == ""


def test_every_topic_has_a_reason() -> None:
    notes = find_roles(TUTORIAL, DEFAULT).notes
    assert set(notes) == {topic.name for topic in TUTORIAL}
    assert notes["/rslidar_points"] == "LiDAR, by type and name"
    assert notes["/zed2/zed/rgb/camera_info"] == "calibration of zed"
    assert "'depth' in the name" in notes["/zed2/zed/depth/depth_registered"]
    assert notes["/rosout"] == "not used: nothing here reads rcl_interfaces/msg/Log"


def test_both_cameras_of_a_stereo_pair_play_once_each() -> None:
    assert cameras(find_roles(TUTORIAL + STEREO, DEFAULT)) == {
        "zed": "/zed2/zed/rgb/image_rect_color",
        "zed_right": "/zed2/zed/right/image_rect_color",
    }
    assert cameras(find_roles(STEREO, DEFAULT)) == {
        "zed_left": "/zed2/zed/left/image_rect_color",
        "zed_right": "/zed2/zed/right/image_rect_color",
    }


def test_variants_of_an_image_count_once_without_frame_ids() -> None:
    live = [Topic(t.name, t.type) for t in TUTORIAL]
    assert cameras(find_roles(live, DEFAULT)) == {"zed": "/zed2/zed/rgb/image_rect_color"}


def test_cameras_side_by_side_in_a_namespace_are_two_cameras() -> None:
    topics = [Topic("/cameras/front", IMAGE), Topic("/cameras/rear", IMAGE)]
    assert list(cameras(find_roles(topics, DEFAULT))) == ["cameras_front", "cameras_rear"]


AUTOWARE = {  # cloud topics of its sensing, below /sensing/lidar, by frame
    "velodyne_top": ["top/pointcloud_raw", "top/pointcloud_raw_ex"],
    "velodyne_left": ["left/pointcloud_raw_ex"],
    "base_link": [
        "top/self_cropped/pointcloud_ex",
        "top/rectified/pointcloud_ex",
        "top/pointcloud_before_sync",
    ],
}


def test_raw_and_transformed_clouds_count_as_one_lidar() -> None:
    topics = [
        Topic(f"/sensing/lidar/{name}", CLOUD, 9, frame)
        for frame, names in AUTOWARE.items()
        for name in names
    ]
    raw = ("/sensing/lidar/left/pointcloud_raw_ex", "/sensing/lidar/top/pointcloud_raw")
    assert find_roles(topics, DEFAULT).lidars == raw
    moved = [topic for topic in topics if topic.frame_id == "base_link"]
    assert find_roles(moved, DEFAULT).lidars == ("/sensing/lidar/top/pointcloud_before_sync",)
    alone = [Topic("/lidar/points", CLOUD, 9, "base_link")]
    assert find_roles(alone, DEFAULT).lidars == ("/lidar/points",)


def test_transforms_of_another_robot_are_not_mixed_in() -> None:
    kinds = {"lidar/points": CLOUD, "camera/image_raw": IMAGE, "tf": TF, "tf_static": TF}
    robots = [Topic(f"/{name}/{t}", kind, 9, t[:3]) for name in ("a", "b") for t, kind in kinds.items()]
    beside = [Topic("/tf", TF, 9), Topic("/localization/tf", TF, 9)]
    roles = find_roles(robots + beside, DEFAULT)
    assert (roles.lidars, roles.tf_static) == (("/a/lidar/points",), ("/a/tf_static",))
    assert roles.tf == ("/a/tf", "/localization/tf", "/tf")
    assert "another robot" in roles.notes["/b/tf"]
    chosen = SourceConfig(lidar_topics=["/b/lidar/points"], camera_topics=["/b/camera/image_raw"])
    assert find_roles(robots, chosen).tf == ("/b/tf",)
    assert find_roles([t for t in robots if t.type == TF], DEFAULT).tf == ("/a/tf", "/b/tf")


def test_what_a_stage_is_taken_from_is_no_truth() -> None:
    topics = [Topic("/points", CLOUD, 9, "lidar"), Topic("/sim/ground_truth", BOXES_3D, 9, "lidar")]
    assert find_roles(topics, DEFAULT).truth == "/sim/ground_truth"
    roles = find_roles(topics, DEFAULT, {"objects.method": "/sim/ground_truth"})
    assert (roles.truth, roles.robot_detections_3d) == ("", ("/sim/ground_truth",))


@pytest.mark.parametrize("radar", ["/radar_front/points", "/ti_mmwave/cloud", "/sonar/points"])
def test_a_radars_cloud_is_not_merged_with_a_lidars(radar: str) -> None:
    topics = [Topic("/velodyne_points", CLOUD, 9, "velodyne"), Topic(radar, CLOUD, 9, "other")]
    roles = find_roles(topics, DEFAULT)
    assert roles.lidars == ("/velodyne_points",)
    assert "a radar's" in roles.notes[radar]
    assert find_roles(topics[1:], DEFAULT).lidars == (radar,)


def test_colour_is_preferred_to_infrared_in_one_frame() -> None:
    topics = [Topic(f"/kinect/{kind}/image_raw", IMAGE, 9, "camera") for kind in ("ir", "rgb")]
    assert list(cameras(find_roles(topics, DEFAULT)).values()) == ["/kinect/rgb/image_raw"]


def test_images_that_a_driver_makes_of_scans_are_no_cameras() -> None:
    made = [f"/ouster/{kind}_image" for kind in ("range", "signal", "reflec", "nearir")]
    topics = [Topic("/ouster/points", CLOUD, 9, "os_lidar"), *(Topic(t, IMAGE, 9, "os_lidar") for t in made)]
    topics.append(Topic("/radar/polar", IMAGE, 9, "navtech"))
    assert find_roles(topics, DEFAULT).cameras == ()


def test_ros_1_spelling_of_types() -> None:
    ros1 = [Topic(t.name, t.type.replace("/msg/", "/"), t.count, t.frame_id) for t in TUTORIAL]
    assert find_roles(ros1, DEFAULT).cameras == find_roles(TUTORIAL, DEFAULT).cameras


def test_a_compressed_image_plays_where_it_is_the_only_one() -> None:
    topics = [
        Topic("/cam_front/image_raw/compressed", JPEG, 5, "cam"),
        Topic("/cam_front/camera_info", INFO, 5, "cam"),
    ]
    (camera,) = find_roles(topics, DEFAULT).cameras
    assert camera.name == "cam_front" and camera.kind == "CompressedImage" and not camera.rectified
    assert camera.info_topic == "/cam_front/camera_info"


@pytest.mark.parametrize(
    ("image", "info", "info_frame"),
    [
        ("/camera", "/camera_info", ""),
        ("/zed/zed_node/rgb/color/rect/image", "/zed/zed_node/rgb/color/rect/camera_info", ""),
        ("/front/image", "/front/image/camera_info", ""),
        ("/front/color/image_raw", "/front/camera_info", ""),
        ("/images/front", "/calibration/front", "front_optical"),
    ],
)
def test_camera_info_is_found_beside_its_image(image: str, info: str, info_frame: str) -> None:
    topics = [
        Topic(image, IMAGE, 5, "front_optical"),
        Topic("/other/camera_info", INFO, 5, "other_optical"),
        Topic(info, INFO, 5, info_frame),
    ]
    assert [camera.info_topic for camera in find_roles(topics, DEFAULT).cameras] == [info]


def test_a_camera_without_calibration_plays_without() -> None:
    topics = [Topic("/front/image", IMAGE, 5, "front"), Topic("/rear/camera_info", INFO, 5, "rear")]
    roles = find_roles(topics, DEFAULT)
    assert [camera.info_topic for camera in roles.cameras] == [""]
    assert roles.notes["/front/image"].endswith("without CameraInfo")
    assert roles.camera_infos == ("/rear/camera_info",)
    roles = find_roles([*topics, Topic("/rear/image", IMAGE, 5, "rear")], DEFAULT)
    assert not roles.camera_infos, "the calibration of another camera is no remedy"


def test_rectified_is_seen_in_the_name_and_can_be_stated() -> None:
    def rectified(name: str, stated: str = "auto") -> bool:
        config = SourceConfig.model_validate({"rectified": stated})
        return find_roles([Topic(name, IMAGE)], config).cameras[0].rectified

    assert rectified("/cam/image_rect") and rectified("/cam/rect/image") and rectified("/cam/image_rectified")
    assert not rectified("/cam/image_raw") and not rectified("/cam/image_unrectified")
    assert rectified("/cam/image_raw", "yes") and not rectified("/cam/image_rect", "no")


def test_several_lidars_play_and_derived_clouds_do_not() -> None:
    topics = [
        Topic("/ouster/points", CLOUD, 9, "os_sensor"),
        Topic("/ouster/points_deskewed", CLOUD, 9, "os_sensor"),
        Topic("/rear/velodyne_points", CLOUD, 9, "velodyne_rear"),
        Topic("/global_map", CLOUD, 9, "map"),
        Topic("/obstacle_points", CLOUD, 9, "base_link"),
        Topic("/aligned_points", CLOUD, 9, "odom"),
    ]
    roles = find_roles(topics, DEFAULT)
    assert roles.lidars == ("/ouster/points", "/rear/velodyne_points")
    assert roles.lidar_names == ("os_sensor", "velodyne_rear")
    assert (
        roles.notes["/ouster/points_deskewed"]
        == "not used: the sensor of /ouster/points, by its frame or name"
    )


def test_a_derived_cloud_plays_where_there_is_no_other() -> None:
    derived, silent = Topic("/camera/depth/points", CLOUD, 9, "cam"), Topic("/lidar", CLOUD, 0)
    assert find_roles([derived, silent], DEFAULT).lidars == ("/camera/depth/points",)
    result = Topic("/map", CLOUD, 9, "map")
    assert find_roles([result, derived], DEFAULT).lidars == ("/camera/depth/points",)
    assert find_roles([result], DEFAULT).lidars == ("/map",)
    assert find_roles([silent], DEFAULT).lidars == ("/lidar",)
    nothing = find_roles([], DEFAULT)
    assert nothing.no_lidar == "no LiDAR: none of 0 topics is a sensor_msgs/PointCloud2; there are none"
    assert nothing.no_camera == "no camera: there is no topic of sensor_msgs/Image or CompressedImage"
    assert nothing == Roles()


@pytest.mark.parametrize(
    ("kind", "helps"),
    [
        ("rslidar_msgs/msg/RslidarScan", "play them through its driver and record its PointCloud2"),
        ("ouster_sensor_msgs/msg/PacketMsg", "play them through its driver"),
        ("nebula_msgs/msg/NebulaPackets", "play them through its driver"),
        ("sensor_msgs/msg/MultiEchoLaserScan", "laser_proc makes a LaserScan of it"),
        ("sensor_msgs/PointCloud", "point_cloud_converter makes a PointCloud2 of it"),
    ],
)
def test_points_in_another_form_have_a_remedy_that_works(kind: str, helps: str) -> None:
    """To state such a topic is none: that is refused with the same remedy."""
    topics = [Topic("/points", kind, 9, "lidar"), Topic("/tf", "tf2_msgs/msg/TFMessage", 9)]
    roles = find_roles(topics, DEFAULT)
    assert roles.lidars == () and "set source.lidar_topics" not in roles.no_lidar
    assert roles.no_lidar.startswith(
        "no LiDAR: none of 2 topics is a sensor_msgs/PointCloud2; /points holds "
    )
    assert helps in roles.no_lidar and helps in roles.notes["/points"]
    with pytest.raises(UserError, match="but must be PointCloud2 or LaserScan; it holds ") as error:
        find_roles(topics, SourceConfig(lidar_topics=("/points",)))
    assert helps in str(error.value)


@pytest.mark.parametrize(
    ("topic", "said"),
    [
        (
            Topic("/cam", "h264_msgs/msg/Packet", 9),
            "/cam holds video .* republish it as images",
        ),
        (Topic("/cam", "h264_image_transport_msgs/msg/Video", 9), "/cam holds video"),
        (Topic("/cam", "my_theora_msgs/msg/Packet", 9), "/cam holds video"),
        (Topic("/debug", IMAGE, 9), r"among the images: --set source\.camera_topics=\[/debug\]$"),
        (Topic("/cam", IMAGE, 0), "there are no messages on /cam"),
    ],
)
def test_a_missing_camera_has_a_reason(topic: Topic, said: str) -> None:
    roles = find_roles([Topic("/lidar", CLOUD, 9), topic], DEFAULT)
    assert roles.cameras == () and re.search(f"^no camera.*{said}", roles.no_camera)
    if "camera_topics" in said:  # the remedy works
        assert cameras(find_roles([topic], SourceConfig(camera_topics=(topic.name,))))


def test_an_unknown_name_of_a_cloud_is_no_hindrance() -> None:
    assert find_roles([Topic("/top", CLOUD, 9, "top")], DEFAULT).lidars == ("/top",)


def test_ground_truth_is_told_from_the_robots_own_boxes() -> None:
    topics = [Topic("/sim/ground_truth", BOXES_3D, 5), Topic("/fused", BOXES_3D, 5)]
    roles = find_roles(topics, DEFAULT)
    assert roles.truth == "/sim/ground_truth" and roles.robot_detections_3d == ("/fused",)


def test_stated_topics_are_taken_as_they_are() -> None:
    config = SourceConfig(
        lidar_topics=("/zed2/zed/point_cloud/cloud_registered", "/rslidar_points"),
        camera_topics=("/visualization/bev_image",),
        camera_info_topics={"/visualization/bev_image": "/zed2/zed/depth/camera_info"},
        odometry_topic="/zed2/zed/odom",
    )
    roles = find_roles(TUTORIAL, config)
    assert roles.lidars == config.lidar_topics
    assert cameras(roles) == {"bev_image": "/visualization/bev_image"}
    assert roles.cameras[0].info_topic == "/zed2/zed/depth/camera_info"
    assert roles.notes["/zed2/zed/rgb/image_rect_color"] == "not used: not in source.camera_topics"


@pytest.mark.parametrize(
    ("stated", "sentence"),
    [
        (
            {"lidar_topics": ["/rslidar_point"]},
            "source.lidar_topics: there is no topic /rslidar_point; .*/rslidar_points",
        ),
        (
            {"camera_topics": ["/zed/rgb/image_rect_color"]},
            "there is no topic .*/zed2/zed/rgb/image_rect_color",
        ),
        (
            {"lidar_topics": ["/tf"]},
            "source.lidar_topics: /tf is a tf2_msgs/msg/TFMessage, but must be PointCloud2",
        ),
        (
            {"odometry_topic": "/odom"},
            "source.odometry_topic: there is no topic /odom; the nearest are /zed2/zed/odom",
        ),
        (
            {"camera_info_topics": {"/zed2/zed/rgb/image_rect_color": "/none"}},
            "source.camera_info_topics: there is no topic /none",
        ),
        (
            {"camera_info_topics": {"/none": "/zed2/zed/rgb/camera_info"}},
            "source.camera_info_topics: .*no topic /none",
        ),
    ],
)
def test_an_unknown_stated_topic_is_reported(stated: dict[str, object], sentence: str) -> None:
    with pytest.raises(UserError, match=sentence):
        find_roles(TUTORIAL, SourceConfig.model_validate(stated))


def test_a_stated_topic_of_another_type_is_reported() -> None:
    with pytest.raises(UserError, match="no topic /points; there is no PointCloud2 or LaserScan topic"):
        find_roles([], SourceConfig(lidar_topics=("/points",)))


@pytest.mark.parametrize(
    ("topic", "frame", "name"),
    [
        ("/rslidar_points", "rslidar", "rslidar"),
        ("/points", "robot_1/front lidar", "robot_1_front_lidar"),
        ("/zed2/zed/rgb/image_rect_color", "", "zed"),
        ("/zed/zed_node/rgb/color/rect/image", "", "zed"),
        ("/camera/camera/color/image_raw", "", "camera"),
        ("/front/camera/image_raw/compressed", "", "front_camera"),
        ("/stereo/left/image_raw", "", "stereo_left"),
        ("/kitti/camera_color_left/image_raw", "", "camera_color_left"),
        ("/image_raw", "", "camera"),
    ],
)
def test_sensors_have_readable_entity_names(topic: str, frame: str, name: str) -> None:
    assert entity_name(topic, frame) == name


def test_names_that_would_clash_are_told_apart() -> None:
    topics = [
        Topic("/a/zed/image_raw", IMAGE, 5, "a"),
        Topic("/b/zed/image_raw", IMAGE, 5, "b"),
        Topic("/bev/points", CLOUD, 5, "bev"),
    ]
    roles = find_roles(topics, DEFAULT)
    assert list(cameras(roles)) == ["a_zed", "b_zed"]
    assert roles.lidar_names == ("bev_points",)


@pytest.mark.parametrize("name", sorted(RESERVED))
def test_a_sensor_called_like_something_else_in_a_recording(name: str) -> None:
    (found,) = find_roles([Topic(f"/{name}", CLOUD, 5, name)], DEFAULT).lidar_names
    assert found not in RESERVED
    assert name in found


def test_sensor_names_may_not_be_reserved_entity_names() -> None:
    """Paths of sensors have the sensor's name in braces."""
    roots = (entities.WORLD, entities.COMPARE, entities.BEV)
    paths = [value for value in vars(entities).values() if isinstance(value, str)]
    taken = {path.split("/")[2] for path in paths if path.startswith(tuple(f"{root}/" for root in roots))}
    taken = {name for name in taken if not name.startswith("{")}
    assert {"tracks", "fused", "about"} <= taken <= RESERVED


PART = st.sampled_from(["zed", "zed2", "left", "rgb", "image_raw", "points", "lidar", "fused", "bev", "c d"])
NAME = st.lists(PART, min_size=1, max_size=3).map(lambda parts: "/" + "/".join(parts))
TOPICS = st.lists(
    st.builds(
        Topic,
        NAME,
        st.sampled_from([CLOUD, IMAGE, JPEG, INFO]),
        st.none(),
        st.sampled_from(["", "zed", "bev"]),
    ),
    unique_by=lambda t: t.name,
    max_size=8,
)


@given(TOPICS.flatmap(lambda topics: st.tuples(st.just(topics), st.permutations(topics))))
def test_names_are_unique_and_the_order_of_topics_is_no_matter(
    orders: tuple[list[Topic], list[Topic]],
) -> None:
    topics, shuffled = orders
    roles = find_roles(topics, DEFAULT)
    names = [*roles.lidar_names, *cameras(roles)]
    assert len(set(names)) == len(roles.lidars) + len(roles.cameras)
    assert not set(names) & RESERVED
    assert all(name.replace("_", "").isalnum() for name in names)
    assert set(roles.notes) == {topic.name for topic in topics}
    assert find_roles(shuffled, DEFAULT) == roles
