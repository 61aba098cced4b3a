//! The schema of scenes (`docs/scene.schema.json`) among the description's own, so that a client can make a valid scene from it.

use serde_json::Value;
use utoipa::openapi::schema::{AllOf, Object};
use utoipa::openapi::{OpenApi, Ref, RefOr, Schema};

/// The schema, as it is published.
const SCENE: &str = include_str!("../../../docs/scene.schema.json");
/// Its name here; those of its parts follow after a full stop.
const NAME: &str = "Scene";

/// Adds the schema, and refers to it from where a scene is a member.
pub(super) fn add(document: &mut OpenApi) {
    let Some(components) = &mut document.components else { return };
    components.schemas.extend(schemas());
    if let Some(RefOr::T(Schema::AllOf(AllOf { items, .. }))) = components.schemas.get_mut("FieldSpec") {
        for item in items {
            if let RefOr::T(Schema::Object(Object { properties, .. })) = item
                && let Some(scene) = properties.get_mut("scene")
            {
                *scene = RefOr::Ref(Ref::from_schema_name(NAME));
            }
        }
    }
}

/// The schema and its parts, by their names here.
fn schemas() -> Vec<(String, RefOr<Schema>)> {
    let text = SCENE.replace("\"#/$defs/", &format!("\"#/components/schemas/{NAME}."));
    // the file is a part of the program, and a test reads it
    let Ok(Value::Object(mut whole)) = serde_json::from_str(&text) else { return Vec::new() };
    whole.remove("$schema");
    let parts = whole.remove("$defs");
    let parts = parts.as_ref().and_then(Value::as_object).into_iter().flatten();
    let parts = parts.map(|(name, part)| (format!("{NAME}.{name}"), part.clone()));
    let all = [(NAME.to_owned(), Value::Object(whole))].into_iter().chain(parts);
    all.filter_map(|(name, schema)| Some((name, serde_json::from_value(schema).ok()?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_of_the_schema_is_lost_on_the_way_into_the_description() {
        let text = SCENE.replace("\"#/$defs/", "\"#/components/schemas/Scene.");
        let published: Value = serde_json::from_str(&text).expect("JSON");
        let document = serde_json::to_value(crate::http::document()).expect("JSON");
        let here = &document["components"]["schemas"];
        for (name, part) in published["$defs"].as_object().expect("parts") {
            assert_eq!(&here[format!("Scene.{name}")], part, "{name}");
        }
        assert_eq!(here["Scene"]["oneOf"], published["oneOf"]);
        let field = here["FieldSpec"]["allOf"].as_array().expect("parts");
        let scene = field.iter().map(|part| &part["properties"]["scene"]["$ref"]).find(|scene| scene.is_string());
        assert_eq!(scene.expect("a reference"), "#/components/schemas/Scene");
    }
}
