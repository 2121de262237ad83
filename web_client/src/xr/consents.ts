// Consent in a headset: who asks for the robot that one holds, with two answers to point at; whose consent one waits for.

import { Group } from "three";

import type { Actions } from "../ui/actions.ts";
import { answerConsent } from "../ui/robots.ts";
import type { ConsentAsked, PageState } from "../ui/state.ts";
import { Label } from "../view/labels.ts";
import { moveTo } from "./props.ts";
import { type Answer, ANSWERS, findAnswer, isBeforeEyes, placeQuestion, type QuestionPlace } from "./question.ts";
import type { FrameReading, Side } from "./reading.ts";
import { describeConsent } from "./words.ts";

/** Answers appear this long after the question [ms]: a press that was meant for a robot is no answer. */
const READ_MS = 700;
const QUESTION_COLOR = "#e0a33a";
const ANSWER_COLORS = { grant: "#35d0ba", refuse: "#e0656a" } as const;
const ANSWER_WORDS = { grant: "Give it", refuse: "Keep it" } as const;

/** An answer that a hand points at. */
export interface Aim {
  side: Side;
  target: Answer;
  /** Along the ray [m]. */
  distance: number;
}

/** The panel of one headset. */
export class ConsentPanel {
  /** In the tracking frame. */
  readonly group = new Group();
  /** Answers that can be given, null: none yet. */
  answers: QuestionPlace["answers"] | null = null;
  private readonly question = new Label(0.03);
  private readonly labels = { grant: new Label(0.038), refuse: new Label(0.038) };
  private asked: ConsentAsked | null = null;
  private place: QuestionPlace | null = null;
  private since_ms = 0;

  constructor(
    private readonly state: PageState,
    private readonly actions: Actions,
  ) {
    for (const { sprite } of [this.question, ...Object.values(this.labels)]) {
      sprite.material.depthTest = false;
      sprite.renderOrder = 20;
      this.group.add(sprite);
    }
    this.question.sprite.center.set(0.5, 0); // more lines grow upward, away from the answers
  }

  /** Take a frame. Returns what hands point at. `waiting`: the line about one's own request, or empty. */
  update({ head, inputs, capture_ms }: FrameReading, waiting: string): Aim[] {
    const now = performance.now();
    const asked = this.state.consents.find(({ until_ms }) => until_ms > now) ?? null;
    if (asked?.consent_id !== this.asked?.consent_id) this.place = null;
    this.asked = asked;
    const isShown = asked !== null || waiting !== "";
    if (!isShown) this.place = null;
    else if (head && !(this.place && isBeforeEyes(head, this.place))) [this.place, this.since_ms] = [placeQuestion(head), capture_ms];
    const isAnswerable = asked !== null && capture_ms - this.since_ms >= READ_MS;
    this.answers = (isAnswerable && this.place?.answers) || null;
    const aims = inputs.flatMap(({ side, ray, tracked }): Aim[] => {
      const found = ray && tracked && this.answers ? findAnswer(ray, this.answers) : null;
      return found ? [{ side, target: found.answer, distance: found.distance }] : [];
    });
    const lines = asked ? describeConsent(this.state.nameOf(asked.requester), asked.target, asked.until_ms - now) : [waiting];
    this.draw(lines, aims.map(({ target }) => target));
    return aims;
  }

  /** Answer the question that is shown. */
  answer(answer: Answer): void {
    if (this.asked) answerConsent(this.asked, answer === "grant", this.state, this.actions);
  }

  dispose(): void {
    for (const label of [this.question, ...Object.values(this.labels)]) label.dispose();
  }

  private draw(lines: readonly string[], aimed: readonly Answer[]): void {
    const { place } = this;
    this.question.setText(place ? lines : [], QUESTION_COLOR);
    if (place) moveTo(this.question.sprite, place.at);
    for (const answer of ANSWERS) {
      const mark = aimed.includes(answer) ? "▶ " : "";
      this.labels[answer].setText(this.answers ? [mark + ANSWER_WORDS[answer]] : [], ANSWER_COLORS[answer]);
      if (this.answers) moveTo(this.labels[answer].sprite, this.answers[answer]);
    }
  }
}
