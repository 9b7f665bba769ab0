//! The table at the end of `train RECORDING`.

use crate::cli::terminal::or_dash;
use crate::replay::{RecordingVerdict, SideVerdict};

/// What the model of `best_epoch` is worth on its recordings, as a table.
pub(super) fn table(verdict: &RecordingVerdict, best_epoch: u32) -> String {
    let mut text = format!(
        "\nThe weights of epoch {best_epoch} on the recording:\n\
         {:<12}{:>18}{:>22}{:>10}{:>12}{:>24}\n\
         {:<12}{:>9}{:>9}{:>13}{:>9}{:>10}{:>12}{:>12}{:>12}\n",
        "",
        "off the wheel",
        "off the path's wheel",
        "autonomy",
        "put back",
        "beside the path",
        "side",
        "MAE",
        "÷zero",
        "MAE",
        "÷zero",
        "",
        "a km",
        "mean",
        "95 % below"
    );
    for side in &verdict.sides {
        text += &line(side);
    }
    text += "÷zero: squared error ÷ that of a wheel held straight; driven on the recorded pictures, warped to where the car is\n";
    for note in &verdict.notes {
        text += &format!("note: {note}\n");
    }
    text
}

/// How the model drove on the recordings after the first training and after each round of DAgger.
pub(super) fn rounds(verdicts: &[&RecordingVerdict]) -> String {
    let mut text =
        String::from("\nround      autonomy: training  validation      beside the path: training  validation\n");
    for (round, verdict) in verdicts.iter().enumerate() {
        let of = |name: &str| verdict.sides.iter().find(|side| side.side == name).and_then(|side| side.drive.as_ref());
        let [training, validation] = ["training", "validation"].map(of);
        let number = |value: Option<f64>, unit: &str, decimals: usize| {
            value.map_or("-".into(), |value| format!("{value:.decimals$} {unit}"))
        };
        let name = if round == 0 { "first".into() } else { round.to_string() };
        text += &format!(
            "{name:<10}{:>20}{:>12}{:>31}{:>12}\n",
            number(training.map(|drive| drive.autonomy_percent), "%", 1),
            number(validation.map(|drive| drive.autonomy_percent), "%", 1),
            number(training.map(|drive| drive.offset_mean_m), "m", 2),
            number(validation.map(|drive| drive.offset_mean_m), "m", 2),
        );
    }
    text
}

fn line(side: &SideVerdict) -> String {
    let deg = |mae_deg: Option<f64>| mae_deg.map_or("-".into(), |mae_deg| format!("{mae_deg:.2}°"));
    let driven = side.drive.as_ref().map_or([(); 4].map(|()| "-".into()), |drive| {
        [
            format!("{:.1} %", drive.autonomy_percent),
            format!("{:.1}", drive.interventions_per_km),
            format!("{:.2} m", drive.offset_mean_m),
            format!("{:.2} m", drive.offset_p95_m),
        ]
    });
    let [autonomy, per_km, mean, p95] = driven;
    format!(
        "{:<12}{:>9}{:>9}{:>13}{:>9}{autonomy:>10}{per_km:>12}{mean:>12}{p95:>12}\n",
        side.side,
        deg(side.wheel_mae_deg),
        or_dash(side.wheel_relative_to_zero, 2),
        deg(side.path_mae_deg),
        or_dash(side.path_relative_to_zero, 2),
    )
}
