//! Which column of a log holds what.

use std::collections::BTreeMap;

use crate::dataset::description::{Column, ColumnRef};
use crate::text::excerpt;

/// Which column, from 0, holds what; `None` where there is no such column.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Columns {
    pub images: [Option<usize>; 3],
    pub steering: usize,
    /// Throttle, brake, speed.
    pub numbers: [Option<usize>; 3],
    /// Who steered: `user` or `pilot`.
    pub mode: Option<usize>,
    /// Columns that the header names.
    pub count: usize,
}

impl Columns {
    /// The usual order.
    pub const USUAL: Columns = Columns {
        images: [Some(0), Some(1), Some(2)],
        steering: 3,
        numbers: [Some(4), Some(5), Some(6)],
        mode: None,
        count: 7,
    };

    /// Whether the first seven columns are the usual ones.
    pub fn are_usual(&self) -> bool {
        Columns { count: 7, mode: None, ..self.clone() } == Columns::USUAL
    }
}

/// Exact names, and parts of names where no exact one is there.
fn names_of(column: Column) -> (&'static [&'static str], &'static [&'static str]) {
    match column {
        Column::Center => (
            &["center", "centre", "center_image", "centre_image", "image", "img", "filename", "file", "frame", "path"],
            &["center", "centre", "image", "file"],
        ),
        Column::Left => (&["left", "left_image"], &["left"]),
        Column::Right => (&["right", "right_image"], &["right"]),
        Column::Steering => (
            &["steering", "steering_angle", "steeringangle", "user/angle", "user/steering", "steer", "angle"],
            &["steer", "angle"],
        ),
        Column::Throttle => (&["throttle", "user/throttle"], &["throttle"]),
        Column::Brake => (&["brake", "reverse"], &["brake", "reverse"]),
        Column::Speed => (&["speed", "speed_mph"], &["speed"]),
    }
}

/// Finds the columns that `header` names and `said` chooses.
///
/// `Ok(None)`: the header is in another language, and the order is taken for the usual one.
///
/// # Errors
/// What cannot be told, with the columns and how to choose.
pub(crate) fn find(header: &[&str], said: &BTreeMap<Column, ColumnRef>) -> Result<Option<Columns>, String> {
    let names: Vec<String> =
        header.iter().map(|name| name.trim().trim_matches('"').to_lowercase().replace(' ', "_")).collect();
    let listed = || {
        let columns: Vec<String> =
            header.iter().enumerate().map(|(i, name)| format!("{} {}", i + 1, excerpt(name.trim(), 40))).collect();
        columns.join(", ")
    };
    let choose = |column: Column| {
        format!(
            "choose with --columns {0}=NUMBER, or with {0} = NUMBER under [columns] in steersman.toml beside the log; the \
             columns are {1}",
            column.name(),
            listed()
        )
    };
    let find = |column: Column| -> Result<Option<usize>, String> {
        match said.get(&column) {
            Some(ColumnRef::Number(number)) if (1..=names.len()).contains(number) => return Ok(Some(number - 1)),
            Some(ColumnRef::Number(number)) => {
                return Err(format!("there is no column {number} for {}; {}", column.name(), choose(column)));
            }
            Some(ColumnRef::Name(name)) => {
                let wanted = name.trim().to_lowercase().replace(' ', "_");
                return match names.iter().position(|found| *found == wanted) {
                    Some(place) => Ok(Some(place)),
                    None => Err(format!("there is no column \"{}\"; {}", excerpt(name, 40), choose(column))),
                };
            }
            None => {}
        }
        let (exact, parts) = names_of(column);
        for name in exact {
            let mut places = (0..names.len()).filter(|&i| names[i] == *name);
            match (places.next(), places.next()) {
                (Some(_), Some(_)) => return Err(format!("two columns are called \"{name}\"; {}", choose(column))),
                (Some(place), None) => return Ok(Some(place)),
                _ => {}
            }
        }
        let places: Vec<usize> =
            (0..names.len()).filter(|&i| parts.iter().any(|part| names[i].contains(part))).collect();
        match places[..] {
            [] => Ok(None),
            [place] => Ok(Some(place)),
            _ => Err(format!("several columns may hold {}: {}", column.name(), choose(column))),
        }
    };
    let mut places = [None; 7];
    for (place, column) in places.iter_mut().zip(Column::ALL) {
        *place = find(column)?;
    }
    let [center, left, right, steering, throttle, brake, speed] = places;
    let Some(steering) = steering else {
        // What is known stands where it usually does.
        let usual = places.iter().enumerate().all(|(i, place)| place.is_none_or(|place| place == i));
        if usual && (center.is_some() || header.len() == 7) {
            return Ok(None);
        }
        let unknown = if center.is_some() { "the steering" } else { "picture and steering" };
        return Err(format!("no column is known to hold {unknown}; {}", choose(Column::Steering)));
    };
    let Some(center) = center else {
        return Err(format!("no column is known to hold the picture; {}", choose(Column::Center)));
    };
    // A column that is there for another reason is no side camera.
    let side = |place: Option<usize>| place.filter(|place| *place != center);
    Ok(Some(Columns {
        images: [Some(center), side(left), side(right)],
        steering,
        numbers: [throttle, brake, speed],
        mode: names.iter().position(|name| ["mode", "user/mode"].contains(&name.as_str())),
        count: header.len(),
    }))
}

/// The columns of a log without a header that `said` chooses; the others are the usual ones.
pub(crate) fn without_header(said: &BTreeMap<Column, ColumnRef>) -> Result<Option<Columns>, String> {
    if said.is_empty() {
        return Ok(None);
    }
    let mut places: [Option<usize>; 7] = std::array::from_fn(Some);
    for (column, reference) in said {
        match reference {
            ColumnRef::Number(number) if *number > 0 => places[*column as usize] = Some(number - 1),
            _ => return Err(format!("the log has no header: say the number of the column for {}", column.name())),
        }
    }
    let [center, left, right, steering, throttle, brake, speed] = places;
    let count = places.iter().flatten().max().map_or(7, |last| last + 1).max(7);
    let steering = steering.unwrap_or(3);
    Ok(Some(Columns { images: [center, left, right], steering, numbers: [throttle, brake, speed], mode: None, count }))
}

#[cfg(test)]
mod tests {
    use super::super::super::description::parse_columns;
    use super::*;

    fn columns(header: &str, said: &str) -> Result<Option<Columns>, String> {
        find(&header.split(',').collect::<Vec<_>>(), &parse_columns(said).unwrap())
    }

    #[test]
    fn exact_names_go_before_parts_of_names() {
        let found = columns("center,left,right,yaw_angle,steering,throttle,brake,speed", "").unwrap().unwrap();
        assert_eq!(found.steering, 4);
        let found = columns("center,left,right,Steering Angle,throttle,reverse,speed", "").unwrap().unwrap();
        assert!(found.are_usual());
        let found = columns("center,left,right,steering,throttle,brake,speed,lap", "").unwrap().unwrap();
        assert!(found.are_usual() && found.count == 8);
        let found = columns("center,left,right,steering,throttle,brake,speed,mode", "").unwrap().unwrap();
        assert!(found.are_usual() && (found.count, found.mode) == (8, Some(7)));
    }

    #[test]
    fn what_is_ambiguous_is_asked_for_with_the_columns() {
        let header = "center,left,right,yaw_angle,wheel_angle,throttle,brake,speed";
        let message = columns(header, "").unwrap_err();
        assert!(message.contains("--columns steering=") && message.contains("4 yaw_angle, 5 wheel_angle"), "{message}");
        assert_eq!(columns(header, "steering=5").unwrap().unwrap().steering, 4);
        assert_eq!(columns(header, "steering=wheel_angle").unwrap().unwrap().steering, 4);
        assert!(columns(header, "steering=9").unwrap_err().contains("no column 9"));
        assert!(columns(header, "steering=x").unwrap_err().contains("no column \"x\""));
    }

    #[test]
    fn a_header_in_another_language_has_the_usual_order() {
        assert_eq!(columns("Mitte,Links,Rechts,Lenkung,Gas,Bremse,Tempo", ""), Ok(None));
        assert!(columns("Mitte,Lenkung", "").is_err());
    }
}
