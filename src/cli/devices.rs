//! `sci-recon devices`: lists graphics cards, and tries the devices that networks can run on.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use serde::Serialize;

use super::output::print_line;
use crate::cli::error::{CliError, Result};
use engine::pipeline::NetworkSource;
use reconstruction::priors::onnx::Device;

/// Devices that are tried.
const TRIED: [Device; 3] = [Device::Cpu, Device::Gpu, Device::Cuda(0)];
/// Vendors of graphics cards by their PCI number, as sysfs writes it.
const VENDORS: [(&str, &str); 3] = [("0x1002", "AMD"), ("0x10de", "NVIDIA"), ("0x8086", "Intel")];

/// List graphics cards, and try the devices for networks.
///
/// Runs a small network on each device and compares the result with the CPU's. A device that can't be used is listed with
/// the reason and the remedy.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Path of libonnxruntime [default: next to the program, or in ../lib/sci-recon, ../lib or ../../runtime].
    #[arg(long, value_name = "FILE", env = "ORT_DYLIB_PATH")]
    onnxruntime: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    /// Measure the kernels of the GPU on 8 frames with these sides in pixels, for example 256,512. Needs a build with the
    /// feature gpu.
    #[arg(long, value_name = "SIDES", value_delimiter = ',', value_parser = clap::value_parser!(u16).range(1..))]
    kernels: Vec<u16>,
}

/// A graphics card with a kernel driver.
#[derive(Debug, PartialEq, Eq, Serialize)]
struct Card {
    name: String,
    /// PCI address.
    address: String,
    driver: Option<String>,
    /// Memory of the card, if its driver states it.
    memory_bytes: Option<u64>,
}

/// Outcome of a pass on a device.
#[derive(Debug, Serialize)]
struct Trial {
    device: String,
    usable: bool,
    /// Seconds of loading a network and one pass.
    seconds: f64,
    /// Why the device can't be used.
    reason: Option<String>,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let cards = cards(Path::new("/"));
    let trials: Vec<Trial> = TRIED.iter().map(|&device| attempt(arguments, device)).collect();
    let kernels =
        if arguments.kernels.is_empty() { None } else { Some(kernels(&arguments.kernels)?) };
    if arguments.json {
        let mut report = serde_json::json!({"cards": cards, "devices": trials});
        if let Some(kernels) = kernels {
            report["kernels"] = kernels;
        }
        print_line(report)?;
        return verdict(&trials);
    }
    print_line("Graphics cards:")?;
    if cards.is_empty() {
        print_line("  none with a kernel driver (/sys/class/drm)")?;
    }
    for Card { name, address, driver, memory_bytes } in cards {
        let driver = driver.map_or("no driver".to_owned(), |driver| format!("driver {driver}"));
        let memory = memory_bytes.map_or("unknown memory".to_owned(), |bytes| {
            format!("{:.1} GiB", bytes as f64 / f64::from(1 << 30))
        });
        print_line(format!("  {name}, {driver}, {memory}, at {address}"))?;
    }
    print_line("Devices for networks:")?;
    for Trial { device, seconds, reason, .. } in &trials {
        let outcome = match reason {
            None => format!("usable, tried in {seconds:.1} s"),
            Some(reason) => format!("not usable: {reason}"),
        };
        print_line(format!("  --device {device}: {outcome}"))?;
    }
    if let Some(kernels) = kernels {
        print_line(format!("Kernels:\n{kernels:#}"))?;
    }
    verdict(&trials)
}

/// Frames of the measurement of kernels.
#[cfg(feature = "gpu")]
const KERNEL_FRAMES: usize = 8;

/// The GPU, and for each side the megavoxels per second of each kernel and of their loop.
#[cfg(feature = "gpu")]
fn kernels(sides: &[u16]) -> Result<serde_json::Value> {
    use reconstruction::gpu::adapter::Gpu;
    use reconstruction::speed::measure;

    let gpu = std::sync::Arc::new(Gpu::open()?);
    let mut report = serde_json::json!({"gpu": gpu.name(), "mvoxel_per_s": {}});
    for &side in sides {
        for speed in measure(&gpu, KERNEL_FRAMES, side.into())? {
            let rounded = (1e3 * speed.mvoxel_per_s).round() / 1e3;
            report["mvoxel_per_s"][side.to_string()][speed.kernel] = rounded.into();
        }
    }
    Ok(report)
}

#[cfg(not(feature = "gpu"))]
fn kernels(_: &[u16]) -> Result<serde_json::Value> {
    let text = "--kernels: this program runs no kernels on a GPU; build it with --features gpu";
    Err(CliError::Input(text.into()))
}

/// Fails if no device can be used.
fn verdict(trials: &[Trial]) -> Result<()> {
    let is_usable = trials.iter().any(|trial| trial.usable);
    is_usable.then_some(()).ok_or_else(|| CliError::Failure("no device can be used".into()))
}

/// Tries to run a network on a device.
fn attempt(arguments: &Arguments, device: Device) -> Trial {
    let library = arguments.onnxruntime.clone().filter(|path| !path.as_os_str().is_empty());
    let source = NetworkSource::new(library, device);
    let start = Instant::now();
    // The version loads the library, which the CPU needs, too.
    let tried = source.version().map(drop).and_then(|()| source.try_device());
    let reason = tried.err().map(|error| error.to_string());
    let seconds = start.elapsed().as_secs_f64();
    Trial { device: device.to_string(), usable: reason.is_none(), seconds, reason }
}

/// The graphics cards that the kernel lists below `root`.
fn cards(root: &Path) -> Vec<Card> {
    let entries = |folder: &str| {
        let entries = fs::read_dir(root.join(folder)).into_iter().flatten().flatten();
        entries.map(|entry| entry.path()).collect::<BTreeSet<_>>()
    };
    let drm = entries("sys/class/drm").into_iter().filter(|path| {
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned());
        name.and_then(|name| name.strip_prefix("card").map(|rest| rest.parse::<u32>().is_ok()))
            == Some(true)
    });
    let mut cards: Vec<Card> = drm.filter_map(|path| card(&path.join("device"))).collect();
    for folder in entries("proc/driver/nvidia/gpus") {
        let address = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let information = text(&folder.join("information")).unwrap_or_default();
        let model = information.lines().find_map(|line| line.strip_prefix("Model:"));
        let name = model.map_or("NVIDIA", str::trim).to_owned();
        match cards.iter_mut().find(|card| card.address == address) {
            Some(card) => card.name = name,
            // A container may lack sysfs.
            None => {
                let driver = Some("nvidia".to_owned());
                cards.push(Card { name, address, driver, memory_bytes: None });
            }
        }
    }
    cards
}

/// The card in this folder of sysfs. `None` if it is no PCI device.
fn card(device: &Path) -> Option<Card> {
    let vendor = text(&device.join("vendor"))?;
    let model = text(&device.join("device"))?;
    let vendor = VENDORS.iter().find(|(number, _)| *number == vendor).map_or(&*vendor, |it| it.1);
    let last = |path: PathBuf| {
        let path = path.canonicalize().ok()?;
        Some(path.file_name()?.to_string_lossy().into_owned())
    };
    Some(Card {
        name: format!("{vendor} {model}"),
        address: last(device.to_owned())?,
        driver: last(device.join("driver")),
        memory_bytes: text(&device.join("mem_info_vram_total")).and_then(|text| text.parse().ok()),
    })
}

/// The text of a file without spaces around it.
fn text(path: &Path) -> Option<String> {
    Some(fs::read_to_string(path).ok()?.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::{Card, cards};
    use std::fs;
    use std::os::unix::fs::symlink;

    #[test]
    fn cards_are_read_from_the_kernel() {
        let root = tempfile::tempdir().unwrap();
        let path = |name: &str| root.path().join(name);
        let write = |name: &str, text: &str| {
            fs::create_dir_all(path(name).parent().unwrap()).unwrap();
            fs::write(path(name), text).unwrap();
        };
        assert_eq!(cards(root.path()), []);
        for (address, vendor, number) in
            [("0000:03:00.0", "0x1002", 0), ("0000:41:00.0", "0x10de", 1)]
        {
            let device = format!("sys/devices/{address}");
            write(&format!("{device}/vendor"), &format!("{vendor}\n"));
            write(&format!("{device}/device"), "0x744c\n");
            fs::create_dir_all(path(&format!("sys/class/drm/card{number}"))).unwrap();
            // sysfs also lists the outputs of a card.
            fs::create_dir_all(path(&format!("sys/class/drm/card{number}-DP-1"))).unwrap();
            symlink(path(&device), path(&format!("sys/class/drm/card{number}/device"))).unwrap();
        }
        write("sys/devices/0000:03:00.0/mem_info_vram_total", "8589934592\n");
        fs::create_dir_all(path("sys/drivers/amdgpu")).unwrap();
        symlink(path("sys/drivers/amdgpu"), path("sys/devices/0000:03:00.0/driver")).unwrap();
        for address in ["0000:41:00.0", "0000:42:00.0"] {
            let file = format!("proc/driver/nvidia/gpus/{address}/information");
            write(&file, "Model: \t\t NVIDIA H100\nIRQ: 1\n");
        }
        let card = |name: &str, address: &str, driver: Option<&str>, memory_bytes| Card {
            name: name.into(),
            address: address.into(),
            driver: driver.map(Into::into),
            memory_bytes,
        };
        let expected = [
            card("AMD 0x744c", "0000:03:00.0", Some("amdgpu"), Some(8 << 30)),
            card("NVIDIA H100", "0000:41:00.0", None, None),
            card("NVIDIA H100", "0000:42:00.0", Some("nvidia"), None),
        ];
        assert_eq!(cards(root.path()), expected);
    }
}
