// A job type for Flamenco 3: lift a scene, bake a camera or frames of it in parallel, and collect the result.
// Put this file into the folder "scripts" beside flamenco-manager. docs/farms.md says which variables it needs:
// {plgs} is the folder of PLGS, {plgsPython} the Python of its engine. Paths may hold two-way variables.

const JOB_TYPE = {
    label: "PLGS: Lift and Bake",
    description: "Lift posed RGB-D frames into a panoptic scene, and bake passes of it.",
    settings: [
        { key: "scene", type: "string", subtype: "dir_path", required: true, visible: "submission",
          description: "The capture, as 'lift' takes it" },
        { key: "output", type: "string", subtype: "dir_path", required: true, visible: "submission",
          description: "The lift folder, which is made or continued" },
        { key: "preset", type: "string", choices: ["draft", "preview", "standard", "paper"], default: "standard",
          description: "How much work to spend" },
        { key: "lift_options", type: "string", default: "", visible: "submission",
          description: "Further options of 'lift', separated by spaces, such as --masks MASKS" },
        { key: "lifted", type: "bool", default: false, visible: "submission",
          description: "The lift folder already holds the lift, with its own preset and options" },
        { key: "bake", type: "string", choices: ["camera", "frames"], default: "camera",
          description: "A camera of a .blend, or frames of the capture" },
        { key: "blend", type: "string", subtype: "file_path", default: "", eval: "bpy.data.filepath",
          description: "The .blend that has the camera" },
        { key: "camera", type: "string", default: "", eval: "C.scene.camera.name if C.scene.camera else ''",
          description: "The camera's name; empty: the .blend's active one" },
        { key: "shot", type: "string", default: "", visible: "submission",
          description: "The name of the camera's files; empty: the .blend's and the camera's" },
        { key: "frames", type: "string", required: true, eval: "f'{C.scene.frame_start}-{C.scene.frame_end}'",
          description: "The camera's frames, or the last numbers in the frames' names: '1-250' or '1-9,20'" },
        { key: "chunk_size", type: "int32", default: 50, propargs: { min: 1 },
          description: "Frames that one task bakes" },
        { key: "layers", type: "string", default: "", visible: "submission",
          description: "Further layers, separated by spaces: normal position" },
    ],
};

function compileJob(job) {
    const settings = job.settings;
    const lift = author.Task("lift", "misc");
    lift.addCommand(engine(["lift", settings.scene, "-o", settings.output, "--resume"].concat(liftOptions(settings))));
    job.addTask(lift);

    const collect = author.Task("collect", "blender");
    for (const chunk of frameChunker(settings.frames, settings.chunk_size)) {
        const bake = author.Task(`bake-${chunk}`, settings.bake === "camera" ? "blender" : "misc");
        for (const part of chunk.split(",")) {
            bake.addCommand(bakeCommand(settings, part.includes("-") ? part : `${part}-${part}`));
        }
        bake.addDependency(lift);
        job.addTask(bake);
        collect.addDependency(bake);
    }

    // The lift is finished by now: it is only checked, and its own .blend shows all passes.
    const again = [settings.scene, "-o", settings.output, "--resume"].concat(liftOptions(settings));
    collect.addCommand(python(["{plgs}/run_plgs.py"].concat(again)));
    job.addTask(collect);
}

function bakeCommand(settings, range) {
    const layers = settings.layers ? ["--layers"].concat(words(settings.layers)) : [];
    if (settings.bake === "frames") {
        return engine(["bake", settings.output, "--frames", range].concat(layers));
    }
    const blend = settings.blend ? ["--blend", settings.blend] : [];
    const camera = settings.camera ? [`--camera=${settings.camera}`] : [];
    const named = settings.shot ? [`--shot=${settings.shot}`] : [];
    const shot = ["-o", settings.output, "--bake", "camera"].concat(blend, camera, named, ["--range", range], layers);
    return python(["{plgs}/run_plgs.py"].concat(shot));
}

function liftOptions(settings) {
    if (settings.lifted) return [];
    return ["--preset", settings.preset].concat(words(settings.lift_options));
}

function engine(args) {
    return python(["{plgs}/engine/__main__.py"].concat(args));
}

function python(args) {
    return author.Command("exec", { exe: "{plgsPython}", args: args });
}

function words(text) {
    return text ? text.split(" ").filter((word) => word !== "") : [];
}
