(* What is said. Nothing is proved here, and of a theorem that Coq accepts nothing else has to be read.
   Equations are those of Zhu, Wen, Peng, Yang, Control and Decision 35(8), 2020; Q2R q is the rational q as a real. *)
Require Import QArith Qreals Reals List Bool.
Import ListNotations.

Definition matrix := list (list Q).
Record sensor := Sensor { beta : Q; seen : bool; weight : Q; C : matrix; D : matrix }.
Record network := Network {
  A : matrix; B : matrix; M : matrix; nodes : list sensor;
  rho : matrix; (* entry i, j: how probably what j sends reaches i *)
  unbiased : bool; adjacency : list matrix; Pi : matrix;
  K : list (list (list matrix)); H : list (list (list matrix)) (* of mode s: at node i, for what node j sends *) }.
Definition entry {T} (i j : nat) (X : list (list T)) (d : T) : T := nth j (nth i X []) d.

(* Over anything that has sums, multiples, and is there or 0 by chance: over numbers, once chance has decided. *)
Section Filters.
Variables (T : Type) (null : T) (plus : T -> T -> T) (by_ : Q -> T -> T) (chance : nat -> T -> T) (f : network).
Definition add (x y : list T) := map (fun ab => plus (fst ab) (snd ab)) (combine x y).
Definition scale (c : Q) (x : list T) := map (by_ c) x.
Definition sub x y := add x (scale (-1) y).
Definition dot (row : list Q) (x : list T) :=
  fold_right plus null (map (fun cy => by_ (fst cy) (snd cy)) (combine row x)).
Definition act (X : matrix) (x : list T) := map (fun row => dot row x) X.
Definition sized (k : nat) (x : list T) := map (fun i => nth i x null) (seq 0 k).

Definition n := length (nodes f).
Definition n_x := length (A f).
Definition n_w := length (hd [] (B f)).
Definition modes := length (Pi f).
Definition node j := nth j (nodes f) (Sensor 0 false 0 [] []).

(* What is thrown at every step: n measurements, then n x n messages. What always arrives is not left to chance. *)
Definition chances := map beta (nodes f) ++ concat (rho f).
Definition sometimes (k : nat) (x : list T) := if Qeq_bool (nth k chances 1) 1 then x else map (chance k) x.

(* The state: x, and the estimate of every node. A node that misses a message takes its own estimate for it. *)
Definition state := (list T * list (list T))%type.
Definition estimate (st : state) j := nth j (snd st) [].
Definition innovation (st : state) w j :=                                                                 (* (2) *)
  let signal := act (C (node j)) (fst st) in
  let expected := act (C (node j)) (estimate st j) in
  let noise := act (D (node j)) w in
  if seen (node j) then sometimes j (sub (add signal noise) expected)
  else sub (add (sometimes j signal) noise) (scale (beta (node j)) expected).
Definition neighbours s i := filter (fun j => negb (Qle_bool (entry i j (nth s (adjacency f) []) 0) 0)) (seq 0 n).
Definition weighed s i j X x := scale (entry i j (nth s (adjacency f) []) 0) (act (entry i j (nth s X []) []) x).
Definition message s (st : state) w i j := sometimes (n + i * n + j)
  (add (weighed s i j (K f) (sub (estimate st j) (estimate st i))) (weighed s i j (H f) (innovation st w j))).
Definition alone s (st : state) i :=
  if unbiased f then act (A f) (estimate st i)
  else fold_right add (sized n_x []) (map (fun j => weighed s i j (K f) (estimate st i)) (neighbours s i)).
Definition step s (st : state) w : state :=
  (sized n_x (add (act (A f) (fst st)) (act (B f) w)),                                                    (* (1) *)
   map (fun i => sized n_x (fold_right add (alone s st i) (map (message s st w i) (neighbours s i))))     (* (5) *)
     (seq 0 n)).
Definition errors (st : state) := map (sub (fst st)) (snd st).
Definition z (st : state) :=
  concat (map (fun ve => scale (weight (fst ve)) (act (M f) (snd ve))) (combine (nodes f) (errors st))).
Definition eta (with_x : bool) (st : state) := (if with_x then fst st else []) ++ concat (errors st).
End Filters.

Open Scope R_scope.
Definition times (q : Q) (y : R) := Q2R q * y.
Definition thrown (o : list bool) (k : nat) (y : R) := if nth k o false then y else 0.
Definition sum (x : list R) := fold_right Rplus 0 x.
Definition norm2 (x : list R) := sum (map (fun a => a * a) x).
Definition performance := z R 0 Rplus times.
Definition next f o := step R 0 Rplus times (thrown o) f.
Definition origin f : state R := (sized R 0 (n_x f) [], map (fun _ => sized R 0 (n_x f) []) (seq 0 (n f))).

(* The mean over all that may be thrown, independently, and over the mode after mode s. *)
Fixpoint mean (ps : list Q) (g : list bool -> R) : R :=
  match ps with
  | [] => g []
  | p :: ps' => Q2R p * mean ps' (fun o => g (true :: o)) + (1 - Q2R p) * mean ps' (fun o => g (false :: o)) end.
Definition switched f s (g : nat -> R) :=
  sum (map (fun t => Q2R (entry s t (Pi f) 0%Q) * g t) (seq 0 (modes f))) / sum (map Q2R (nth s (Pi f) [])).
Definition expected f s (g : list bool -> nat -> R) := mean (chances f) (fun o => switched f s (g o)).

(* k steps of a disturbance that knows all that was thrown before: w, and how it goes on after every outcome. *)
Fixpoint plan (k : nat) : Type :=
  match k with O => unit | S k' => (list R * (list bool -> nat -> plan k'))%type end.
Fixpoint energy f k s : plan k -> R :=
  match k with
  | O => fun _ => 0
  | S k' => fun p => norm2 (sized R 0 (n_w f) (fst p)) + expected f s (fun o t => energy f k' t (snd p o t)) end.
Fixpoint peak f k s (st : state R) : plan k -> R :=
  match k with
  | O => fun _ => norm2 (performance f st)
  | S k' => fun p =>
      expected f s (fun o t => peak f k' t (next f o s st (sized R 0 (n_w f) (fst p))) (snd p o t)) end.

(* Dimensions fit, and probabilities are such. *)
Definition is (r c : nat) (X : matrix) := (length X =? r)%nat && forallb (fun row => (length row =? c)%nat) X.
Definition probable (p : Q) := Qle_bool 0 p && Qle_bool p 1.
Definition proper f :=
  let ok := (fun s i j => Qle_bool (entry i j (nth s (adjacency f) []) 0%Q) 0 ||
    is (n_x f) (n_x f) (entry i j (nth s (K f) []) []) &&
    is (n_x f) (length (C (node f j))) (entry i j (nth s (H f) []) [])) in
  is (n_x f) (n_x f) (A f) && is (n_x f) (n_w f) (B f) && is (length (M f)) (n_x f) (M f) &&
  forallb (fun v => is (length (C v)) (n_x f) (C v) && is (length (C v)) (n_w f) (D v)) (nodes f) &&
  is (n f) (n f) (rho f) && is (modes f) (modes f) (Pi f) && (length (adjacency f) =? modes f)%nat &&
  forallb (is (n f) (n f)) (adjacency f) &&
  forallb (fun s => forallb (fun i => forallb (ok s i) (seq 0 (n f))) (seq 0 (n f))) (seq 0 (modes f)) &&
  forallb probable (chances f) && forallb (forallb probable) (Pi f) &&
  forallb (fun row => negb (Qeq_bool (fold_right Qplus 0%Q row) 0)) (Pi f).

(* E |z(k)|^2 <= gamma^2 E (|w(0)|^2 + ... + |w(k-1)|^2) for every k, first mode and disturbance. *)
Definition bounded f (gamma : Q) := proper f = true /\ 0 <= Q2R gamma /\
  forall k s (w : plan k), (s < modes f)%nat -> peak f k s (origin f) w <= Q2R gamma * Q2R gamma * energy f k s w.

(* x'Px, of a symmetric P that is stored as its rows from the diagonal on. Entries that are left out are 0. *)
Fixpoint inner (b x : list R) := match b, x with c :: b', y :: x' => c * y + inner b' x' | _, _ => 0 end.
Fixpoint form (P : list (list R)) (x : list R) : R :=
  match P, x with
  | (a :: b) :: P', y :: x' => a * y * y + 2 * y * inner b x' + form P' x'
  | [] :: P', _ :: x' => form P' x'
  | _, _ => 0 end.
Definition V with_x (P : list matrix) s (st : state R) :=
  form (map (map Q2R) (nth s P [])) (eta R Rplus times with_x st).
Definition fits f (st : state R) :=
  length (fst st) = n_x f /\ length (snd st) = n f /\ Forall (fun x => length x = n_x f) (snd st).
Definition zero (x : list R) := Forall (fun y => y = 0) x.
Definition theorem_1 f (gamma : Q) with_x (P : list matrix) := forall s st, (s < modes f)%nat -> fits f st ->
  (forall w, length w = n_w f -> ~ zero (w ++ eta R Rplus times with_x st) ->
    expected f s (fun o t => V with_x P t (next f o s st w)) < norm2 w + V with_x P s st) /\           (* (17) *)
  (~ zero (eta R Rplus times with_x st) ->
    norm2 (performance f st) < Q2R gamma * Q2R gamma * V with_x P s st).                                    (* (18) *)
