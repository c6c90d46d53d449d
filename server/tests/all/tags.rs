//! Tags, and players that look at what was.

use protocol::message::TagOutcome;
use protocol::tag::Tag;
use protocol::{GarmentId, StateId, VersionNumber, store};

use crate::player::Player;
use crate::world::World;

const GARMENT: GarmentId = GarmentId(0);

fn kept(world: &World, number: u64) -> Option<Tag> {
    let bytes = std::fs::read(world.path(&store::tag_path(number))).ok()?;
    Some(Tag::decode(&bytes).unwrap())
}

#[tokio::test]
async fn a_tag_needs_its_own_right_and_outlives_the_server() {
    let mut world = World::new();
    world.publish(2);
    let config = server::ServerConfig { tag_token: Some("pointer".into()), ..world.config() };
    let server = server::Server::start(config.clone()).await.unwrap();
    let mut plain = Player::new(&server, Some("letmein"));
    plain.until("a version", |player| player.versions.len() == 1).await;
    assert!(plain.machine.tag(GARMENT, StateId(5)));
    plain.until("an answer", |player| !player.tagged.is_empty()).await;
    assert_eq!(plain.tagged, [(StateId(5), TagOutcome::NotAllowed)]);
    assert_eq!(kept(&world, 1), None);

    let mut pointing = Player::new(&server, Some("pointer"));
    pointing.until("a version", |player| player.versions.len() == 1).await;
    for (garment, state) in [(GARMENT, 5), (GARMENT, 7), (GARMENT, 9999), (GarmentId(3), 5)] {
        let before = pointing.tagged.len();
        assert!(pointing.machine.tag(garment, StateId(state)));
        pointing.until("an answer", |player| player.tagged.len() > before).await;
    }
    let outcomes: Vec<_> = pointing.tagged.iter().map(|(_, outcome)| *outcome).collect();
    let kept_as = |number| TagOutcome::Kept { number };
    assert_eq!(outcomes, [kept_as(1), kept_as(2), TagOutcome::Unknown, TagOutcome::Unknown]);
    server.shutdown().await;

    let server = server::Server::start(config).await.unwrap();
    let mut again = Player::new(&server, Some("pointer"));
    again.until("a version", |player| player.versions.len() == 1).await;
    assert!(again.machine.tag(GARMENT, StateId(6)));
    again.until("an answer", |player| !player.tagged.is_empty()).await;
    assert_eq!(again.tagged, [(StateId(6), kept_as(3))]);
    let trail: Vec<_> = (1..=3).map(|number| kept(&world, number).unwrap().state.0).collect();
    assert_eq!(trail, [5, 7, 6]);
    let version = VersionNumber(1);
    assert_eq!(kept(&world, 1), Some(Tag { garment: GARMENT, state: StateId(5), version }));
}

#[tokio::test]
async fn nobody_may_tag_where_no_right_was_given_and_nobody_floods() {
    let mut world = World::new();
    world.publish(2);
    let server = world.serve().await;
    let mut player = Player::new(&server, Some("letmein"));
    player.until("a version", |player| player.versions.len() == 1).await;
    assert!(player.machine.tag(GARMENT, StateId(5)));
    player.until("an answer", |player| !player.tagged.is_empty()).await;
    assert_eq!(player.tagged, [(StateId(5), TagOutcome::NotAllowed)]);
    server.shutdown().await;

    let config = server::ServerConfig { tag_token: Some("pointer".into()), ..world.config() };
    let server = server::Server::start(config).await.unwrap();
    let mut flood = Player::new(&server, Some("pointer"));
    flood.until("a version", |player| player.versions.len() == 1).await;
    for _ in 0..100 {
        assert!(flood.machine.tag(GARMENT, StateId(5)));
    }
    flood.until("all answers", |player| player.tagged.len() == 100).await;
    let refused = flood.tagged.iter().filter(|(_, o)| *o == TagOutcome::TooMany).count();
    assert!((20..=40).contains(&refused), "{refused}");
}

#[tokio::test]
async fn a_pinned_player_gets_its_version_and_no_other() {
    let mut world = World::new();
    for _ in 0..3 {
        world.publish(3);
    }
    let server = world.serve().await;
    let mut now = Player::new(&server, Some("letmein"));
    now.until("the head", |player| !player.versions.is_empty()).await;
    assert_eq!(now.versions, [VersionNumber(3)]);
    let mut pinned = Player::pinned(&server, Some("letmein"), Some(VersionNumber(2)));
    pinned.until("version 2", |p| !p.versions.is_empty() && p.machine.wanted() == 0).await;
    world.publish(3);
    server.notify();
    now.until("version 4", |player| player.versions.len() == 2).await;
    // Some turns more, in which the new head would have come.
    let _ = tokio::time::timeout(
        std::time::Duration::from_millis(300),
        pinned.until("for ever", |_| false),
    )
    .await;
    assert_eq!(pinned.versions, [VersionNumber(2)]);
    let mut nowhere = Player::pinned(&server, Some("letmein"), Some(VersionNumber(77)));
    nowhere.until("the end", |player| player.ended.is_some()).await;
    let said = nowhere.ended.unwrap().to_string();
    assert!(said.contains("77"), "{said}");
}
