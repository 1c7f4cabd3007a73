//! Rules that Cargo does not enforce: no circular imports between files or folders of a crate, and
//! libraries that only some files may name.
//!
//! The sources are parsed. A file depends on the files that define what its `use` lines and its
//! paths name; re-exports are followed. Test code does not count, nor do the lines in which a
//! folder's `mod.rs` lists its children (`mod x;`, `pub use x::Y;`).

#![allow(clippy::unwrap_used)] // tests may panic

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use syn::visit::Visit;

/// Source folders of the crates.
const SOURCES: [&str; 7] = [
    "src",
    "crates/formats/src",
    "crates/optics/src",
    "crates/reconstruction/src",
    "crates/engine/src",
    "crates/store/src",
    "crates/workers/src",
];

/// Crates and modules that only these files and folders may name.
const OWNERS: &[(&str, &[&str])] = &[
    ("ort", &["crates/reconstruction/src/priors/onnx.rs"]),
    ("wgpu", &["crates/reconstruction/src/gpu/", "crates/reconstruction/src/resident.rs"]),
    ("sqlx", &["crates/store/src/"]),
    ("axum", &["src/http/", "src/cli/serve.rs"]),
    ("async_nats", &["crates/workers/src/nats/"]),
    ("crate::http", &["src/http/", "src/cli/serve.rs"]),
];

/// Folders that must not access files.
const WITHOUT_FILES: (&[&str], &[&str], &[&str]) = (
    &["crates/reconstruction/src/", "crates/optics/src/"],
    &["std::fs", "std::path"],
    &["crates/reconstruction/src/priors/onnx.rs"],
);

/// A module's path from the crate's root.
type Module = Vec<String>;

/// The imports and exports of a source file.
#[derive(Default)]
struct File {
    place: String,
    /// True for a folder's `mod.rs`, which lists children.
    is_folder: bool,
    children: BTreeSet<String>,
    /// Imports: the local name, and the path that it stands for.
    imports: BTreeMap<String, Vec<String>>,
    /// Paths of this crate that the file depends on.
    uses: BTreeSet<Vec<String>>,
    /// All other paths that the file names, such as `std::fs`.
    foreign: BTreeSet<String>,
}

struct Reader {
    module: Module,
    file: File,
}

fn is_test(attributes: &[syn::Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        attribute.path().is_ident("cfg")
            && attribute.parse_args::<syn::Meta>().is_ok_and(|meta| meta.path().is_ident("test"))
    })
}

impl Reader {
    /// The path from the crate's root; none for a path of another crate or a local name.
    fn absolute(&self, path: &[String]) -> Option<Vec<String>> {
        let mut base = self.module.clone();
        let mut rest = path;
        match path.first()?.as_str() {
            "crate" => return Some(path[1..].to_vec()),
            "self" => rest = &path[1..],
            "super" => {
                while rest.first().is_some_and(|word| word == "super") {
                    base.pop();
                    rest = &rest[1..];
                }
            }
            first if self.file.children.contains(first) => {}
            _ => return None,
        }
        base.extend_from_slice(rest);
        Some(base)
    }

    fn tree(&mut self, tree: &syn::UseTree, prefix: &[String], public: bool) {
        let with = |name: &dyn ToString| [prefix, &[name.to_string()]].concat();
        match tree {
            syn::UseTree::Path(path) => self.tree(&path.tree, &with(&path.ident), public),
            syn::UseTree::Group(group) => {
                group.items.iter().for_each(|item| self.tree(item, prefix, public));
            }
            syn::UseTree::Name(name) if name.ident == "self" => {
                let shown = prefix.last().cloned().unwrap_or_default();
                self.import(prefix, shown, public);
            }
            syn::UseTree::Name(name) => {
                self.import(&with(&name.ident), name.ident.to_string(), public);
            }
            syn::UseTree::Rename(name) => {
                self.import(&with(&name.ident), name.rename.to_string(), public);
            }
            syn::UseTree::Glob(_) => self.import(&with(&"*"), "*".into(), public),
        }
    }

    fn import(&mut self, path: &[String], shown: String, public: bool) {
        let Some(absolute) = self.absolute(path) else {
            self.file.foreign.insert(path.join("::"));
            return;
        };
        let names_child = absolute.len() > self.module.len() && absolute.starts_with(&self.module);
        if !(public && names_child && self.file.is_folder) {
            self.file.uses.insert(absolute.clone());
        }
        self.file.imports.insert(shown, absolute);
    }
}

impl<'ast> Visit<'ast> for Reader {
    fn visit_item_mod(&mut self, item: &'ast syn::ItemMod) {
        if !is_test(&item.attrs) {
            syn::visit::visit_item_mod(self, item);
        }
    }

    fn visit_item_impl(&mut self, item: &'ast syn::ItemImpl) {
        if !is_test(&item.attrs) {
            syn::visit::visit_item_impl(self, item);
        }
    }

    fn visit_item_fn(&mut self, item: &'ast syn::ItemFn) {
        if !is_test(&item.attrs) {
            syn::visit::visit_item_fn(self, item);
        }
    }

    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        if !is_test(&item.attrs) {
            let public = !matches!(item.vis, syn::Visibility::Inherited);
            self.tree(&item.tree, &[], public);
        }
    }

    /// `pub(in path)` is no dependency.
    fn visit_visibility(&mut self, _: &'ast syn::Visibility) {}

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let words: Vec<String> = path.segments.iter().map(|part| part.ident.to_string()).collect();
        if words.len() > 1 {
            match self.absolute(&words) {
                Some(path) => self.file.uses.insert(path),
                None => self.file.foreign.insert(words.join("::")),
            };
        }
        syn::visit::visit_path(self, path);
    }
}

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

fn read(text: &str, module: Module, place: &str, is_folder: bool) -> File {
    let tree = syn::parse_file(text).unwrap_or_else(|error| panic!("{place}: {error}"));
    let child = |item: &syn::Item| match item {
        syn::Item::Mod(item) if item.content.is_none() => Some(item.ident.to_string()),
        _ => None,
    };
    let children = tree.items.iter().filter_map(child).collect();
    let file = File { place: place.into(), is_folder, children, ..File::default() };
    let mut reader = Reader { module, file };
    reader.visit_file(&tree);
    reader.file
}

/// All files of one crate, except those that contain only tests.
fn read_crate(folder: &str) -> BTreeMap<Module, File> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut paths = Vec::new();
    sources(&root.join(folder), &mut paths);
    let mut files = BTreeMap::new();
    for path in paths {
        let within = path.strip_prefix(root.join(folder)).unwrap().with_extension("");
        let mut module: Module =
            within.iter().map(|word| word.to_string_lossy().into_owned()).collect();
        let tests = |word: &String| word == "tests" || word == "test_support";
        if module[0] == "main" || module.iter().any(tests) {
            continue;
        }
        let listing = module.last().is_some_and(|name| name == "mod" || name == "lib");
        if listing {
            module.pop();
        }
        let file_name = path.strip_prefix(root).unwrap().to_string_lossy().into_owned();
        let text = fs::read_to_string(&path).unwrap();
        let is_folder = listing || path.with_extension("").is_dir();
        files.insert(module.clone(), read(&text, module, &file_name, is_folder));
    }
    files
}

/// The module whose file defines the item of a path from the root.
fn definer(files: &BTreeMap<Module, File>, path: &[String], depth: usize) -> Option<Module> {
    let mut module = Module::new();
    for (index, word) in path.iter().enumerate() {
        let child = [module.as_slice(), std::slice::from_ref(word)].concat();
        if files.contains_key(&child) {
            module = child;
            continue;
        }
        return match files.get(&module)?.imports.get(word) {
            Some(target) if depth > 0 => {
                definer(files, &[target.as_slice(), &path[index + 1..]].concat(), depth - 1)
            }
            _ => Some(module),
        };
    }
    Some(module)
}

/// The files that each file depends on.
fn dependencies(files: &BTreeMap<Module, File>) -> BTreeMap<Module, BTreeSet<Module>> {
    let of = |(module, file): (&Module, &File)| {
        let targets = file.uses.iter().filter_map(|path| definer(files, path, 8));
        (module.clone(), targets.filter(|target| target != module).collect())
    };
    files.iter().map(of).collect()
}

/// The files on which a file depends directly or indirectly.
fn ahead(edges: &BTreeMap<Module, BTreeSet<Module>>, from: &Module) -> BTreeSet<Module> {
    let mut reached = BTreeSet::new();
    let mut open = vec![from];
    while let Some(at) = open.pop() {
        open.extend(edges[at].iter().filter(|next| reached.insert((*next).clone())));
    }
    reached
}

/// Sets of files in which each file depends on all others.
fn circles(edges: &BTreeMap<Module, BTreeSet<Module>>) -> BTreeSet<BTreeSet<Module>> {
    let reached: BTreeMap<&Module, BTreeSet<Module>> =
        edges.keys().map(|module| (module, ahead(edges, module))).collect();
    let circle = |module: &Module| {
        let others = &reached[module];
        others.iter().filter(|other| reached[other].contains(module)).cloned().collect()
    };
    edges.keys().filter(|module| reached[*module].contains(*module)).map(circle).collect()
}

/// The dependencies between the children of each folder. A child that is a folder stands for all files below it.
fn between_siblings(
    edges: &BTreeMap<Module, BTreeSet<Module>>,
) -> BTreeMap<Module, BTreeSet<Module>> {
    let mut siblings: BTreeMap<Module, BTreeSet<Module>> = BTreeMap::new();
    for (from, targets) in edges {
        for to in targets {
            let shared = from.iter().zip(to).take_while(|(a, b)| a == b).count();
            let child = |module: &Module| module[..module.len().min(shared + 1)].to_vec();
            let (from, to) = (child(from), child(to));
            siblings.entry(to.clone()).or_default();
            // The file of a folder depends on its children, but is not one of them.
            if from.len() == to.len() {
                siblings.entry(from).or_default().insert(to);
            }
        }
    }
    siblings
}

/// Describes each circle of `edges` in lines of text.
fn described(folder: &str, edges: &BTreeMap<Module, BTreeSet<Module>>) -> String {
    let mut text = String::new();
    for circle in circles(edges) {
        text += &format!("\n{folder}: a circle of {}:\n", circle.len());
        for module in &circle {
            let next: Vec<String> =
                edges[module].intersection(&circle).map(|other| other.join("::")).collect();
            text += &format!("    {} -> {}\n", module.join("::"), next.join(", "));
        }
    }
    text
}

#[test]
fn no_files_depend_on_each_other_in_a_circle() {
    let text: String = SOURCES
        .iter()
        .map(|folder| described(folder, &dependencies(&read_crate(folder))))
        .collect();
    assert!(text.is_empty(), "{text}");
}

#[test]
fn no_folders_depend_on_each_other_in_a_circle() {
    let text: String = SOURCES
        .iter()
        .map(|folder| described(folder, &between_siblings(&dependencies(&read_crate(folder)))))
        .collect();
    assert!(text.is_empty(), "{text}");
}

#[test]
fn restricted_crates_are_named_only_by_their_owners() {
    let starts = |path: &str, root: &str| {
        path.strip_prefix(root).is_some_and(|rest| rest.is_empty() || rest.starts_with("::"))
    };
    let mut broken = Vec::new();
    let crates = SOURCES.map(read_crate);
    for file in crates.iter().flat_map(BTreeMap::values) {
        let named = |root: &str| {
            let internal = file.uses.iter().map(|path| format!("crate::{}", path.join("::")));
            file.foreign.iter().cloned().chain(internal).any(|path| starts(&path, root))
        };
        let within = |places: &[&str]| places.iter().any(|place| file.place.starts_with(place));
        for (root, owners) in OWNERS {
            if !within(owners) && named(root) {
                broken.push(format!("{} must not know {root}", file.place));
            }
        }
        let (folders, roots, exceptions) = WITHOUT_FILES;
        for root in roots {
            if within(folders) && !within(exceptions) && named(root) {
                broken.push(format!("{} must not know {root}", file.place));
            }
        }
    }
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn the_check_detects_circles() {
    let module = |path: &str| path.split("::").map(str::to_owned).collect::<Module>();
    let file = |path: &str, text: &str, is_folder| {
        (module(path), read(text, module(path), path, is_folder))
    };
    let files = BTreeMap::from([
        (Module::new(), read("mod a;", Module::new(), "lib", true)),
        file("a", "mod b; mod c; mod d; pub use b::Thing;", true),
        // The file imports through the folder's exports, and names a path in an expression.
        file("a::b", "fn f() { super::c::g(); } pub struct Thing;", false),
        file("a::c", "use crate::a::{Thing, d::{self, h}};", false),
        file("a::d", "use std::fs; #[cfg(test)] mod tests { use super::super::c; }", false),
    ]);
    let edges = dependencies(&files);
    assert_eq!(edges[&module("a::c")], BTreeSet::from([module("a::b"), module("a::d")]));
    assert_eq!(edges[&module("a")], BTreeSet::new());
    let circle = BTreeSet::from([module("a::b"), module("a::c")]);
    assert_eq!(circles(&edges), BTreeSet::from([circle]));
    let edge = |from: &str, to: &[&str]| (module(from), to.iter().map(|to| module(to)).collect());
    let edges = BTreeMap::from([
        edge("a", &["b::c"]),
        edge("b", &["b::c", "b::d"]),
        edge("b::c", &["b::d"]),
        edge("b::d", &["a"]),
    ]);
    let folders = BTreeSet::from([module("a"), module("b")]);
    assert_eq!(circles(&between_siblings(&edges)), BTreeSet::from([folders]));
    assert!(files[&module("a::d")].foreign.contains("std::fs"));
}

/// A program without the feature `gpu` is built without these libraries.
#[test]
fn libraries_of_the_gpu_are_optional() {
    let text = fs::read_to_string("crates/reconstruction/Cargo.toml").unwrap();
    let manifest: toml::Table = text.parse().unwrap();
    for name in ["pollster", "wgpu"] {
        let optional = manifest["dependencies"][name].get("optional");
        assert_eq!(optional.and_then(toml::Value::as_bool), Some(true), "{name}");
    }
    let features = manifest["features"].as_table().unwrap();
    assert!(features.get("default").is_none(), "{features:?}");
    let root: toml::Table = fs::read_to_string("Cargo.toml").unwrap().parse().unwrap();
    assert!(root["features"].get("default").is_none());
}

#[test]
fn the_version_and_its_date_are_the_same_everywhere() {
    let text = |path: &str| fs::read_to_string(path).unwrap();
    let between = |path: &str, before: &str, after: &str| {
        let text = text(path);
        let (_, rest) =
            text.split_once(before).unwrap_or_else(|| panic!("{path} lacks {before:?}"));
        rest.split(after).next().unwrap().to_owned()
    };
    let version = env!("CARGO_PKG_VERSION");
    for (path, before, after) in [
        ("CHANGELOG.md", "\n## ", " ("),
        ("CITATION.cff", "\nversion: ", "\n"),
        ("clients/python/pyproject.toml", "\nversion = \"", "\""),
        ("openapi.yaml", "\n  version: ", "\n"),
        ("deploy/conda/recipe.yaml", "\n  version: \"", "\""),
    ] {
        assert_eq!(between(path, before, after), version, "{path}");
    }
    let date = between("CITATION.cff", "\ndate-released: ", "\n");
    assert_eq!(between("CHANGELOG.md", &format!("\n## {version} ("), ")"), date);
}
