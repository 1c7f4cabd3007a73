use ndarray::Array3;
use proptest::prelude::{any, prop, proptest};
use strum::VariantNames;

use crate::mat::SceneArray;
use crate::test_support::{assert_names, file, sample};
use crate::{
    Axes, Expected, Format, FormatError, FullScale, Limits, SampleType, StackInfo, Wanted, collect,
    open_array, read_stack,
};

fn read(name: &str, array: SceneArray) -> Result<(StackInfo, Array3<f32>), FormatError> {
    collect(&mut *open_array(&sample(name), array, &Limits::default())?)
}

fn masks() -> Array3<f32> {
    Array3::from_shape_fn((3, 4, 5), |(k, i, j)| ((k + 2 * i + 3 * j) % 2) as f32)
}

fn snapshots() -> Array3<f32> {
    Array3::from_shape_fn((2, 4, 5), |(k, i, j)| (100 * k + 10 * i + j) as f32)
}

#[test]
fn h5py_arrays_are_read() {
    let (info, values) = read("h5py.h5", SceneArray::Masks).unwrap();
    assert_eq!((info.format, info.sample), (Format::Hdf5, SampleType::Bool));
    assert_eq!((info.default_full_scale, values), (Some(FullScale::ONE), masks()));
    let (info, values) = read("h5py.h5", SceneArray::Measurements).unwrap();
    assert_eq!((info.sample, values), (SampleType::U16, snapshots()));
    assert_eq!(info.default_full_scale, SampleType::U16.default_full_scale());
    let (info, values) = read("h5py.h5", SceneArray::Truth).unwrap();
    assert_eq!((info.sample, values), (SampleType::F32, snapshots()));
    let (info, values) = read("types.h5", SceneArray::Masks).unwrap();
    assert_eq!((info.sample, info.default_full_scale, values), (SampleType::I64, None, masks()));
    let (info, values) = read("types.h5", SceneArray::Measurements).unwrap();
    assert_eq!((info.sample, values), (SampleType::F16, snapshots()));
}

#[test]
fn arrays_are_read_by_name_and_errors_list_the_names() {
    let open = |file: &str, name: &str| {
        let wanted = Wanted { name: Some(name), ..SceneArray::Measurements.into() };
        collect(&mut *open_array(&sample(file), wanted, &Limits::default())?)
    };
    for file in ["names.h5", "names.mat"] {
        assert_eq!(open(file, "shots").unwrap().1, snapshots(), "{file}");
        for name in ["nothing", "no/thing", "", "/"] {
            let error = open(file, name).unwrap_err();
            assert!(error.is_callers_fault(), "{file} {name}: {error:?}");
            assert_names(&error.to_string(), &["'shots'", "array"]);
        }
    }
    assert_eq!(open("names.h5", "calibrated/masks").unwrap().1, masks());
    let group = open("names.h5", "calibrated").unwrap_err();
    assert!(group.is_callers_fault(), "{group:?}");
}

#[test]
fn plug_in_compressions_of_h5py_are_read_or_refused_with_a_line() {
    let tiled = Array3::from_shape_fn((3, 32, 40), |(k, i, j)| masks()[[k, i % 4, j % 5]]);
    for name in ["lzf.h5", "lz4.h5"] {
        let (info, values) = read(name, SceneArray::Masks).unwrap();
        assert_eq!((info.sample, values), (SampleType::U16, tiled.clone()), "{name}");
    }
    let error = read("blosc.h5", SceneArray::Masks).unwrap_err();
    assert_eq!(error.code(), "unsupported_content");
    let line =
        "import hdf5plugin, h5py, numpy; numpy.save('out.npy', h5py.File('in.h5')['mask'][()])";
    assert_names(&error.to_string(), &["filter id 32001", line]);
}

#[test]
fn files_with_a_user_block_are_read() {
    assert_eq!(read("user-block.h5", SceneArray::Masks).unwrap().1, masks());
}

#[test]
fn arrays_in_groups_are_listed_by_their_paths() {
    let open = |name: &str| {
        let wanted = Wanted { name: Some(name), ..SceneArray::Masks.into() };
        collect(&mut *open_array(&sample("groups.h5"), wanted, &Limits::default())?)
    };
    for name in ["mask", "exchange", "exchange/mask", "exchange/data/more"] {
        let error = open(name).unwrap_err();
        assert_eq!(error.code(), "missing_array", "{error}");
        assert_names(&error.to_string(), &["'exchange/data'", "'exchange/dark'", "`array`"]);
    }
    for name in ["exchange/data", "/exchange/data", "exchange/again/data"] {
        assert_eq!(open(name).unwrap().1, masks(), "{name}");
    }
}

#[test]
fn the_names_of_a_file_list_variables_once() {
    let names = |name| super::names(std::fs::File::open(sample(name)).unwrap()).unwrap();
    assert!(names("octave.h5").iter().any(|name| name == "shots"), "{:?}", names("octave.h5"));
    assert!(names("octave.h5").iter().all(|name| !name.contains('/')), "{:?}", names("octave.h5"));
    assert_eq!(names("user-block.h5"), ["mask"]);
}

#[test]
fn variables_of_octave_are_read() {
    let (info, values) = read("octave.h5", SceneArray::Masks).unwrap();
    assert_eq!((info.sample, values), (SampleType::Bool, masks()));
    let (info, values) = read("octave.h5", SceneArray::Measurements).unwrap();
    assert_eq!((info.default_full_scale, values), (Some(FullScale::EIGHT_BIT), snapshots()));
    // Arrays with other names do not have the scales of the public scenes.
    for name in ["shots", "shots/value"] {
        let wanted = Wanted { name: Some(name), ..SceneArray::Measurements.into() };
        let mut reader = open_array(&sample("octave.h5"), wanted, &Limits::default()).unwrap();
        let (info, values) = collect(&mut *reader).unwrap();
        assert_eq!((info.default_full_scale, values), (Some(FullScale::ONE), snapshots()));
    }
}

#[test]
fn lines_of_python_have_plain_names_only() {
    for (name, shown) in
        [("run 2/C_k", "run 2/C_k"), ("a'b", "NAME"), ("$(x)", "NAME"), ("\"", "NAME")]
    {
        assert_eq!(super::python_name(name), shown);
    }
}

#[test]
fn all_orders_of_axes_are_read() {
    for name in Axes::VARIANTS {
        let axes: Axes = name.parse().unwrap();
        for place in ["", "packed/", "matlab/"] {
            let name = format!("{place}{axes}");
            let expected = Expected { axes: Some(axes), ..Expected::default() };
            let array = SceneArray::Measurements;
            let wanted = Wanted { name: Some(&name), expected, ..array.into() };
            let reader = open_array(&sample("axes.h5"), wanted, &Limits::default());
            let (info, values) = collect(&mut *reader.unwrap()).unwrap();
            assert_eq!((info.axes, values), (Some(axes), snapshots()), "{name}");
        }
    }
}

#[test]
fn matlab_arrays_have_its_axes_and_full_scales() {
    let (info, values) = read("matlab73.mat", SceneArray::Masks).unwrap();
    assert_eq!((info.sample, info.frames, info.height, info.width), (SampleType::Bool, 3, 4, 5));
    assert_eq!((info.default_full_scale, values), (Some(FullScale::ONE), masks()));
    let (info, values) = read("matlab73.mat", SceneArray::Measurements).unwrap();
    assert_eq!(
        (info.sample, info.default_full_scale),
        (SampleType::F64, Some(FullScale::EIGHT_BIT))
    );
    assert_eq!(values, snapshots());
    let (info, values) = read("matlab73.mat", SceneArray::Truth).unwrap();
    assert_eq!((info.sample, values), (SampleType::I32, snapshots()));
}

#[test]
fn errors_state_what_is_supported() {
    let complex = read("types.h5", SceneArray::Truth).unwrap_err();
    assert_names(&complex.to_string(), &["HDF5", "complex", "integers and floats"]);
    let small = Limits { max_frames: 2, ..Limits::default() };
    let Err(large) = open_array(&sample("h5py.h5"), SceneArray::Masks, &small) else { panic!() };
    assert_names(&large.to_string(), &["number of frames is 3", "limit is 2"]);
    let error = read_stack(&sample("h5py.h5"), &Limits::default()).unwrap_err();
    assert_names(&error.to_string(), &["HDF5", "'mask'", "save the array alone"]);
}

#[test]
fn numpy_integers_and_half_floats_are_read() {
    for (name, sample_type) in [
        ("masks-int64.npy", SampleType::I64),
        ("masks-int32-big.npy", SampleType::I32),
        ("masks-int8.npy", SampleType::I8),
        ("masks-float16.npy", SampleType::F16),
    ] {
        let (info, values) = read_stack(&sample(name), &Limits::default()).unwrap();
        assert_eq!((info.sample, values), (sample_type, masks()), "{name}");
    }
    let (info, values) = read_stack(&sample("mask-1-bit.png"), &Limits::default()).unwrap();
    assert_eq!(info.sample, SampleType::Bool);
    assert_eq!(values, masks().slice_move(ndarray::s![..1, .., ..]));
}

proptest! {
    /// Any values are acceptable, but an error must blame the file.
    #[test]
    fn damaged_files_are_read_or_refused(
        name in prop::sample::select(vec!["h5py.h5", "types.h5", "matlab73.mat", "lzf.h5", "lz4.h5", "octave.h5", "groups.h5"]),
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8),
        keep in any::<prop::sample::Index>(),
        cut in any::<bool>(),
    ) {
        let mut bytes = std::fs::read(sample(name)).unwrap();
        for (place, value) in changes {
            let place = place.index(bytes.len());
            bytes[place] = value;
        }
        if cut {
            bytes.truncate(keep.index(bytes.len()));
        }
        let damaged = file(&bytes);
        for array in [SceneArray::Masks, SceneArray::Measurements, SceneArray::Truth] {
            let limits = Limits { max_frames: 16, max_side: 64, ..Limits::default() };
            let read = open_array(damaged.path(), array, &limits).and_then(|mut r| collect(&mut *r));
            if let Err(error) = read {
                assert!(error.is_callers_fault(), "{error:?}");
            }
        }
    }
}
