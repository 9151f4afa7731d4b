"""The commands for one rig: captures -> detections -> extrinsics -> files and images. Start reading here.

    detections = detect(session)                 detect_session.py: the board in all images, scans and events
    result = calibrate(session, detections)      calibration.py: extrinsics and a verdict for each pair
    result.write()                               result_files.py: result.json, YAML, URDF, camera_info
    verify(session, result).write()              verification.py: the point clouds projected into the images

Every step takes the output of the previous one. Results are frozen dataclasses; only the session and the
export layer touch files.
"""
