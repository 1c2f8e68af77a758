"""`plenocli capture-sim`: what a camera records of a scene."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command("capture-sim", short_help="Simulate a capture of a scene or a calibration target.")
@options.input_path("camera")
@click.option(
    "--scene",
    metavar="SCENE",
    help=(
        "Photograph, spectral EXR, image .h5, skimage:astronaut (a photograph that ships with "
        "scikit-image), colorchecker, or labelled spectra as score --classes takes them, which "
        "make a chart."
    ),
)
@click.option(
    "--target",
    metavar="TARGET",
    help=(
        "Instead of a scene: white (a reference of reflectance 0.99), dark, mono:450nm (the "
        "reference under narrow-band light) or colorchecker."
    ),
)
@click.option(
    "--polarisation",
    metavar="DEGREE|PICTURE",
    help=(
        "Degree of linear polarisation of the scene's light, from -1 (all at 90 degrees) to 1 (all "
        "at 0), as a number or a picture: an EXR of one channel, or a grey PNG from 0 to 1. "
        "Default: not polarised."
    ),
)
@click.option(
    "--volume",
    metavar="VOLUME",
    help=(
        "Instead, before a camera with an [objective]: a volume .h5, a TIFF stack with voxel "
        "sizes, or phantom:beads, phantom:shells, phantom:filaments, phantom:target, phantom:slide."
    ),
)
@click.option(
    "--layer",
    "layers",
    metavar="PICTURE@DISTANCE",
    multiple=True,
    help=(
        "Instead, before a photographic camera: an opaque picture at a distance, such as "
        "near.png@380mm, again for each; alpha says where a layer is clear, and nearer layers hide "
        "what is behind them."
    ),
)
@options.output
@click.option("--pif", type=options.FILE, help="Use this system matrix instead of computing one.")
@click.option(
    "--snr",
    "snr_db",
    type=options.DECIBEL,
    help=(
        "White noise of this signal-to-noise ratio, such as 60dB, instead of the sensor's own: "
        "sigma^2 = mean(y^2) 10^(-SNR/10)."
    ),
)
@click.option(
    "--noise",
    type=click.Choice(["sensor", "none"]),
    default="sensor",
    show_default=True,
    help=(
        "Shot, read and quantisation noise of [sensor], or none (real numbers, relative to white)."
    ),
)
@click.option(
    "--exposure",
    type=options.DURATION,
    help=(
        "Exposure time, such as 2.5ms; default the camera's own: [sensor] exposure, or what "
        "fills a perfect white to 80 % of full well."
    ),
)
@click.option(
    "--sampling",
    type=click.Choice(["fit", "crop"]),
    default="fit",
    show_default=True,
    help=(
        "A photograph is fitted to the object grid by area averages, or cropped "
        "at native resolution."
    ),
)
@click.option(
    "--refine",
    type=options.Whole(1, 8),
    default=1,
    show_default=True,
    help="Object points per side for each point of [object]: simulate finer than you invert.",
)
@click.option(
    "--bandwidth",
    type=options.LENGTH,
    default=None,
    help=(
        "Full width at half maximum of each line of light, such as 10nm; default "
        "one exact wavelength."
    ),
)
@click.option(
    "--spectral-step",
    type=options.LENGTH,
    default=None,
    help="Spacing of wavelengths for cameras with colour; default half of the narrowest filter.",
)
@options.superpixels("Superpixels that one lenslet's light may reach")
@options.coherent_ring
@click.option(
    "--accuracy",
    type=options.POSITIVE,
    default=None,
    help="Relative error of the light on the sensor; default: what its noise lets be seen.",
)
@click.option(
    "--field-nodes",
    type=options.Nodes(auto=False),
    default=None,
    help=(
        "Places of the field along an axis (3, 5, 7 ...) whose matrices stand for all lenslets, as "
        "in simulate-pif; default: all are simulated as the one on the axis."
    ),
)
@options.model("Propagation model, as in simulate-pif.")
@click.option(
    "--scene-out",
    type=options.FILE,
    help="Also write the object as sampled (.h5 or .exr): the truth that score compares with.",
)
@options.seed
@options.mem_limit
@options.overwrite
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    camera: Path,
    *,
    scene: str | None,
    target: str | None,
    polarisation: str | None,
    volume: str | None,
    layers: tuple[str, ...],
    output: Path,
    pif: Path | None,
    snr_db: float | None,
    noise: str,
    exposure: float | None,
    sampling: str,
    refine: int,
    bandwidth: float | None,
    spectral_step: float | None,
    superpixels: tuple[int, int] | str,
    coherent_ring: int | str,
    accuracy: float | None,
    field_nodes: int | None,
    model: str,
    scene_out: Path | None,
    seed: int,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Simulate what CAMERA (a .toml file) records of a scene: light, filters, lenses, diffraction,
    colour filters, noise.

    OUT is .h5 (with the object and all settings), .exr or .dng (a real RAW file, for cameras'
    own software too).

    \b
    Examples:
      plenocli capture-sim camera.toml --scene photo.png --snr 60dB -o capture.h5
      plenocli capture-sim camera.toml --target mono:450nm --seed 3 -o band450.dng
      plenocli capture-sim camera.toml --target colorchecker --exposure 2.5ms -o chart.dng
      plenocli capture-sim camera.toml --scene photo.png --polarisation 0.4 -o capture.h5
      plenocli capture-sim camera.toml --scene photo.png --refine 3 --superpixels 3x3 \\
          --snr 60dB -o fine.h5
      plenocli capture-sim microscope.toml --volume phantom:shells --refine 2 --snr 40dB \\
          --scene-out truth.h5 -o capture.h5
      plenocli capture-sim camera.toml --layer near.png@380mm --layer far.png@420mm \\
          --refine 2 --snr 40dB --scene-out truth.h5 -o capture.h5
    """
    from plenocli.stages.forward.capture_settings import Settings
    from plenocli.stages.forward.capture_sim import run_capture_sim

    report = run_capture_sim(
        camera,
        output,
        Settings(
            target=target,
            snr_db=snr_db,
            noise=noise,
            exposure=exposure,
            sampling=sampling,
            refine=refine,
            bandwidth=bandwidth or 0.0,
            spectral_step=spectral_step,
            superpixels=superpixels,
            coherent_ring=coherent_ring,
            accuracy=accuracy,
            field_nodes=field_nodes,
            polarisation=polarisation,
            model=model,
            seed=seed,
        ),
        scene=scene,
        volume=volume,
        layers=layers,
        pif=pif,
        scene_out=scene_out,
        overwrite=overwrite,
        command=options.command_line(ctx),
    )
    noise = (
        f"SNR {snr_db:g} dB, sigma {report.noise_sigma:.3g}"
        if snr_db is not None
        else f"peak {report.peak:.4g} {report.units}"
    )
    options.summary(
        report.as_json(),
        as_json,
        (
            f"{output}: {report.rows} x {report.columns} pixels, {report.wavelengths} "
            f"wavelength{'s'[: report.wavelengths > 1]}, {noise}"
        ),
    )
