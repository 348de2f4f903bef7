"""What users see from end to end, and the test that pins each: `make behaviours` runs these.

    python tests/behaviours.py      # prints the tests, as pytest takes them

tests/test_architecture.py checks that each is there. A test that is renamed or moved is renamed here.
"""

BEHAVIOURS = {
    "a lift writes the files of docs/lift-folder.md": ("lift/test_lift.py::test_a_lift_writes_the_documented_files"),
    "a lift's arrays: points and anchors": "lift/test_lift.py::test_a_lift_writes_its_points_and_anchors",
    "a lift's arrays: instances": "lift/test_lift.py::test_a_lift_writes_its_instances",
    "a lift's passes have the frames' own size": (
        "lift/test_lift.py::test_passes_have_the_frames_size_and_unblended_labels"
    ),
    "a lift with the same seed writes the same bytes": "lift/test_lift.py::test_the_same_seed_gives_the_same_lift",
    "a lift beats the masks that it was given": "lift/test_quality.py::test_a_lift_scores_above_its_masks_and_a_vote",
    "a lift is cancelled and resumed": "lift/test_lift.py::test_a_cancelled_lift_is_resumed",
    "a lift that was killed is resumed to the same bytes": (
        "test_kill_and_resume.py::test_a_lift_that_is_killed_and_resumed_has_the_same_bytes"
    ),
    "a lift keeps the names of an earlier one": "lift/test_lasting_names.py::test_a_new_lift_keeps_ids_in_all_files",
    "a lift finds a scene that was moved": "doors/test_command_line.py::test_find_scene_mends_a_lift_whose_scene_moved",
    "frames are baked later with the same bytes": "lift/test_bake_more.py::test_frames_baked_later_have_the_same_bytes",
    "any camera is baked": "lift/test_bake_more.py::test_any_camera_can_be_baked",
    "several commands bake side by side": "lift/test_bake_more.py::test_two_bake_commands_share_the_frames",
    "corrections change passes, exports and scores": ("lift/test_bake_more.py::test_corrections_reach_every_output"),
    "Blender reads ids and mattes of the passes": "passes/test_exr.py::test_blender_reads_ids_and_mattes_of_pass_files",
    "each format of captures is recognised": (
        "scene/formats/test_recognising.py::test_each_format_has_its_own_name_and_says_what_it_looks_for"
    ),
    "frames of ten layouts": ("doors/test_captures.py::test_the_layout_is_recognised_by_the_files_in_it"),
    "frames of Record3D": "scene/formats/test_record3d.py::test_points_of_a_record3d_scan_lie_on_the_walls",
    "frames of ScanNet's archives": "scene/formats/test_scannet.py::test_points_of_a_scannet_sens_lie_on_the_walls",
    "frames of ScanNet++": "scene/formats/test_scannetpp.py::test_points_of_a_scannetpp_scan_lie_on_the_walls",
    "frames of 7-Scenes": "scene/formats/test_seven_scenes.py::test_raw_7_scenes_depth_is_registered_to_colour",
    "bad scenes and masks are one line": "scene/test_bad_input.py",
    "files of others stay": "doors/test_files_of_others.py::test_no_command_deletes_files_of_other_people",
    "a scene is diagnosed and mended": (
        "doors/test_captures.py::test_inspect_writes_a_mended_scene_and_your_files_stay_as_they_are"
    ),
    "exports: clouds": "export/test_export.py::test_depth_clouds_hold_a_point_for_each_pixel",
    "exports: COCO panoptic": "export/test_export.py::test_exported_coco_masks_hold_the_drawn_ids",
    "exports: label images": "export/test_export.py::test_exported_label_images_hold_the_drawn_ids",
    "exports: ScanNet": "export/test_export.py::test_a_scannet_export_holds_drawn_ids_and_class_names",
    "exports: boxes": "export/test_export.py::test_exported_boxes_equal_those_of_the_lifts_objects",
    "exports: depth maps": "export/test_export.py::test_exported_depth_maps_are_finite_floats",
    "exports: meshes": "export/test_export.py::test_exported_meshes_have_the_labels_and_colours_of_the_room",
    "run_plgs.py lifts a scene into a .blend": (
        "doors/test_command_line.py::test_run_plgs_lifts_the_scene_and_puts_the_result_into_a_blend"
    ),
    "run_plgs.py bakes a camera": "test_run_plgs_camera.py::test_baking_a_camera_again_keeps_finished_frames",
    "the zip installs, registers and goes": "test_extension.py::test_the_zip_can_be_installed_enabled_and_removed",
    "every button works with the engine that the set-up made": (
        "operators/test_every_action.py::test_every_action_works_with_the_engine_that_the_buttons_made"
    ),
    "the panel's buttons: import": "operators/test_scene.py::test_import_scene_adds_cameras_without_lifting",
    "the panel's buttons: lift": "operators/test_lift.py::test_the_lift_operator_in_a_script_waits_for_the_lift",
    "the panel's buttons: resume": "operators/test_lift.py::test_a_cancelled_lift_is_resumed_by_the_operator",
    "the panel's buttons: masks": "operators/test_masks.py::test_make_masks_writes_masks_with_the_networks_classes",
    "the panel's buttons: corrections": ("operators/test_corrections.py::test_undo_brings_back_a_deleted_object"),
    "the panel's buttons: passes": (
        "operators/test_passes.py::test_the_compositor_opens_with_passes_of_the_active_camera"
    ),
    "the panel's buttons: export": "operators/test_export.py::test_export_lift_writes_boxes_and_coco_masks",
    "the panel shows a lift that is finished": "ui/test_panels.py::test_the_panel_shows_a_finished_lift",
}


if __name__ == "__main__":
    print(*[f"tests/{test}" for test in BEHAVIOURS.values()])
