//! A raw measurement is held against the calibration that it belongs to.

use serde_json::{Value, json};

use crate::app::TestApp;
use crate::calibration::{Lab, SIDE, found};
use crate::samples::npy;

impl Lab {
    /// Sends the measurement; gives the body of a request.
    async fn measurement(&self, app: &TestApp, calibration: &Value) -> Value {
        let index = &self.json("captures/captures.json")["measurement"];
        json!({
            "calibration": calibration["id"],
            "data": self.upload(app, &index["data"]).await,
            "dark": [self.upload(app, &index["dark"][0]).await],
            "full_scale": index["full_scale"],
            "saturation": index["saturation"],
        })
    }

    /// The measurement moved by some rows and columns, round the edges.
    fn moved(&self, rows: usize, columns: usize) -> Vec<u8> {
        let mut file = self.file("captures/measurement.npy");
        let start = file.len() - 2 * SIDE * SIDE;
        let pixels = file.split_off(start);
        for at in 0..SIDE * SIDE {
            let (row, column) = ((at / SIDE + rows) % SIDE, (at % SIDE + columns) % SIDE);
            let from = 2 * (row * SIDE + column);
            file.extend(&pixels[from..from + 2]);
        }
        file
    }
}

#[tokio::test]
async fn a_measurement_is_checked_against_its_calibration() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let lab = Lab::new("[camera]\nbackground = 0.1\nmeasurement_exposure = 0.15\n");
    let captures = lab.send(&app).await;
    let calibration = app.calibrate_captures(&captures).await;
    let good = lab.measurement(&app, &calibration).await;
    let post = async |change: &dyn Fn(&mut Value)| {
        let mut body = good.clone();
        change(&mut body);
        app.post("/v1/measurements", &body).await.expect(201).json()
    };
    let codes = |measurement: &Value| {
        found(&measurement["warnings"]).into_iter().map(|(code, _)| code).collect::<Vec<_>>()
    };
    let fine = post(&|_| ()).await;
    assert_eq!(codes(&fine), Vec::<String>::new(), "{fine:#}");
    let undarkened = post(&|body| body["dark"] = json!([])).await;
    assert_eq!(codes(&undarkened), ["wrong_dark"]);
    let too_dark = post(&|body| body["dark"] = captures["white"].clone()).await;
    assert!(codes(&too_dark).contains(&"negative".to_owned()), "{too_dark:#}");
    let data = app.upload(lab.moved(2, 1)).await;
    let moved = post(&|body| body["data"] = json!(data)).await;
    assert_eq!(codes(&moved), ["shifted_masks"]);
    assert!(moved["warnings"][0]["detail"].as_str().unwrap().contains("-2 rows and -1 columns"));
    let full = post(&|body| body["saturation"] = json!(900)).await;
    assert!(codes(&full).contains(&"saturated".to_owned()), "{full:#}");
    // A measurement that lacks a pattern of its calibration.
    let mut lacking = captures.clone();
    let other = Lab::new("[camera]\nbackground = 0.1\n[sub_apertures]\nopen_share = 0.25\n");
    lacking["masks"][4] = other.send(&app).await["masks"][4].clone();
    lacking.as_object_mut().unwrap().remove("patterns");
    let wrong = app.calibrate_captures(&lacking).await;
    let lost = post(&|body| body["calibration"] = wrong["id"].clone()).await;
    let seen = found(&lost["warnings"]);
    assert!(seen.contains(&("missing_pattern".into(), vec![4])), "{lost:#}");
    // Warnings go with the job and stand in its manifest.
    let body = json!({"measurement": moved["id"], "algorithm": "gap-tv"});
    let job = app.submit(&body).await;
    let done = app.ended(&job).await;
    assert_eq!(done["state"], "succeeded", "{done:#}");
    assert_eq!(codes(&done), ["shifted_masks"]);
    for path in ["manifest.json", "snapshots/0/manifest.json"] {
        let manifest = app.get(&format!("/v1/jobs/{job}/{path}")).await.expect(200).json();
        assert_eq!(codes(&manifest["content"]), ["shifted_masks"], "{path}");
    }
    let small = app.upload(npy(&[20, 30], (0..600).map(|_| 1.0))).await;
    let mut body = good.clone();
    body["dark"] = json!([small]);
    let answer = app.post("/v1/measurements", &body).await;
    answer.problem(422, "size_mismatch");
    assert_eq!(answer.json()["pointer"], "/dark/0");
}
