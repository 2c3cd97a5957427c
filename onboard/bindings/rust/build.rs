// SPDX-License-Identifier: MIT
//! Compiles the library's two-file amalgamation with the C compiler of the target: `CC_<target>` or
//! `CC`, else `cc`. `STARCAT_MAX_CENTROIDS` and `STARCAT_MAX_STARS` in the environment set the limits.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

fn run(command: &mut Command) {
    let status = command.status();
    assert!(
        matches!(&status, Ok(code) if code.success()),
        "{command:?} failed ({status:?}); a C99 compiler is needed, name it in CC"
    );
}

/// A tool of the target: `CC_thumbv7em_none_eabihf`, `TARGET_CC`, `CC`, or the default.
fn tool(name: &str, default: &str) -> String {
    let target = env::var("TARGET").unwrap_or_default().replace(['-', '.'], "_");
    let names = [format!("{name}_{target}"), format!("TARGET_{name}"), name.to_string()];
    for name in &names {
        println!("cargo:rerun-if-env-changed={name}");
    }
    names.iter().find_map(|name| env::var(name).ok()).unwrap_or_else(|| default.to_string())
}

fn limit(name: &str, default: &str) -> String {
    println!("cargo:rerun-if-env-changed={name}");
    env::var(name).unwrap_or_else(|_| default.to_string())
}

/// Compile C sources and put them into an archive.
fn archive(out: &Path, name: &str, sources: &[PathBuf], flags: &[String]) -> PathBuf {
    let mut objects = Vec::new();
    for source in sources {
        println!("cargo:rerun-if-changed={}", source.display());
        let object = out.join(source.file_stem().unwrap()).with_extension("o");
        run(Command::new(tool("CC", "cc"))
            .args(["-std=c99", "-O2", "-ftrapping-math", "-fPIC", "-ffunction-sections"])
            .args(flags)
            .arg("-c")
            .arg(source)
            .arg("-o")
            .arg(&object));
        objects.push(object);
    }
    let made = out.join(format!("lib{name}.a"));
    let _ = fs::remove_file(&made);
    run(Command::new(tool("AR", "ar")).arg("rcs").arg(&made).args(&objects));
    made
}

fn main() {
    let out = PathBuf::from(env::var("OUT_DIR").unwrap());
    let here = PathBuf::from(env::var("CARGO_MANIFEST_DIR").unwrap());
    let mut folder = here.join("amalgamation"); // of a packed crate
    if !folder.join("starcat.c").exists() {
        folder = out.join("amalgamation");
        let script = here.join("../../amalgamate.sh");
        println!("cargo:rerun-if-changed={}", script.display());
        println!("cargo:rerun-if-changed={}", here.join("../../src").display());
        println!("cargo:rerun-if-changed={}", here.join("../../include").display());
        run(Command::new("sh").arg(script).arg(&folder));
    }

    let centroids = limit("STARCAT_MAX_CENTROIDS", "64");
    let stars = limit("STARCAT_MAX_STARS", "192");
    let real = if env::var_os("CARGO_FEATURE_SINGLE").is_some() { "float" } else { "double" };
    let mut flags = vec![
        format!("-I{}", folder.display()),
        format!("-DSTARCAT_MAX_CENTROIDS={centroids}"),
        format!("-DSTARCAT_MAX_STARS={stars}"),
    ];
    if real == "float" {
        flags.push("-DSTARCAT_SINGLE".to_string());
    }
    let sizes = out.join("sizes.c");
    fs::write(
        &sizes,
        "#include \"starcat.h\"\nconst uint32_t starcat_crate_sizes[10] = {sizeof(starcat_image), \
         sizeof(starcat_camera), sizeof(starcat_options), sizeof(starcat_frame), \
         sizeof(starcat_result), sizeof(starcat_workspace), sizeof(starcat_neighbours), \
         offsetof(starcat_result, covariance_rad2), offsetof(starcat_result, n_shape), \
         offsetof(starcat_result, star)};\n",
    )
    .unwrap();
    archive(&out, "starcat", &[folder.join("starcat.c"), sizes], &flags);
    println!("cargo:rustc-link-search=native={}", out.display());
    println!("cargo:rustc-link-lib=static=starcat");
    if env::var("CARGO_CFG_UNIX").is_ok() {
        println!("cargo:rustc-link-lib=m");
    }

    // The symbols have the limits in them.
    let suffix = format!("_{centroids}_{stars}_{real}");
    let template = fs::read_to_string(here.join("src/ffi.rs")).unwrap();
    println!("cargo:rerun-if-changed=src/ffi.rs");
    fs::write(
        out.join("ffi.rs"),
        template
            .replace("@SUFFIX@", &suffix)
            .replace("1000001", &centroids)
            .replace("1000002", &stars),
    )
    .unwrap();

    // The made-up sky that the tests look at.
    let sky = here.join("../../tests/random_sky.c");
    if sky.exists() {
        let made = archive(&out, "sky", &[sky], &flags);
        println!("cargo:rustc-link-arg-tests={}", made.display());
    }
}
