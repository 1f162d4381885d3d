"""Examples that stand in the help of every command; the tests parse each of them."""

from __future__ import annotations

EXAMPLES: dict[str, tuple[tuple[str, str], ...]] = {
    "lio": (
        ("boxplus lio flight.bag", "everything is found from the data; results in flight_boxplus"),
        ("boxplus lio flight.bag -o out --gt flight.gt.tum", "compared with a ground truth at the end"),
        ("boxplus lio monday.bag tuesday.bag -o runs", "several (also a folder of them), one table at the end"),
        ("boxplus lio flight.bag -o out --set scan_voxel=0.5 --T-imu-lidar 'xyz_qwxyz: 0.05 0 0.1 1 0 0 0'", ""),
        ("boxplus lio flight.bag -o out --resume", "go on with a run that was stopped"),
    ),
    "slam": (
        ("boxplus slam drive.bag -o out", ""),
        ("boxplus slam drive.bag -o again --loops loops.yaml --set local_maps.length=50", "loops of your own"),
    ),
    "refine": (("boxplus refine out", "a finished run of lio"), ("boxplus refine out -o better --gt truth.tum", "")),
    "localize": (("boxplus localize tuesday.bag --map out -o found", "in the map of a run"),),
    "vio": (
        ("boxplus vio flight.bag --calibration camchain.yaml", ""),
        ("boxplus vio MH_01_easy --gt MH_01_easy/mav0/gt.tum --mono", ""),
    ),
    "vo": (("boxplus vo rgbd_dataset_freiburg1_desk --gt groundtruth.txt", ""), ("boxplus vo kitti/00 --frame-rate 10", "")),
    "ba": (
        ("boxplus ba ladybug-49-7776-pre.txt.bz2", "a BAL file"),
        ("boxplus ba sparse/0 -o adjusted --refine-intrinsics --loss cauchy:1.0", "a COLMAP model"),
        ("boxplus ba scene.txt --json --no-report > run.json", "for a script"),
    ),
    "pgo": (
        ("boxplus pgo sphere2500.g2o", ""),
        ("boxplus pgo loops.g2o -o out --robust gnc", "refuse false loop closures"),
        ("boxplus pgo loops.g2o --json --no-report > run.json", "for a script"),
    ),
    "inspect": (
        ("boxplus inspect flight.bag", ""),
        ("boxplus inspect flight.bag --json", "for a script; exit code 1 where there are errors"),
    ),
    "calibrate lidar-imu": (("boxplus calibrate lidar-imu swung.bag -o calibration.yaml", ""),),
    "calibrate cameras": (("boxplus calibrate cameras corners.yaml --target aprilgrid.yaml --resolution 752x480", ""),),
    "eval": (
        ("boxplus eval out/trajectory.tum truth.tum", "the ground truth comes last"),
        ("boxplus eval out again truth.tum --plot pictures", "several in one table, folders of runs too"),
    ),
    "convert": (
        ("boxplus convert cloud.ply cloud.las", ""),
        ("boxplus convert sparse/0 sparse_text --to colmap-text", "where no ending tells the format"),
        ("boxplus convert ladybug.txt.bz2 sparse --to colmap-binary", "a BAL file for COLMAP"),
    ),
    "map merge": (("boxplus map merge monday tuesday -o both", "runs of slam"),),
    "map update": (("boxplus map update both wednesday", ""),),
    "map info": (("boxplus map info out/map", ""),),
    "map export": (("boxplus map export out/map -o out.las --voxel 0.2", "LAS, thinned"),),
    "map grid": (("boxplus map grid out", ""),),
    "map height": (("boxplus map height out", ""),),
    "fleet run": (
        ("boxplus fleet run recordings -o fleet", "every recording of a folder"),
        (
            "boxplus fleet run overnight.txt -o s3://bucket/fleet --address 10.0.0.5:6379",
            "a list, on a cluster, into an object store",
        ),
    ),
    "report": (("boxplus report flight_boxplus", ""),),
    "simulate": (
        ("boxplus simulate walk -o recordings", "with a LiDAR"),
        ("boxplus simulate room --camera stereo --rate 15", "with cameras"),
    ),
    "demo": (("boxplus demo", ""),),
    "warmup": (("boxplus warmup", ""),),
}
